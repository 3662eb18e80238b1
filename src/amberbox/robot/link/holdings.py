"""Ask the server with each connection whether it holds what this robot takes for confirmed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import msgspec

from amberbox.blackbox.segments import manifest
from amberbox.blackbox.store import FOLDERS
from amberbox.link import holdings
from amberbox.link.holdings import Answer, Copy, Question, Stretch
from amberbox.robot.link.copying import Copier, CopyError

_UNKNOWN = (404, 405)
"""What a server answers that cannot be asked: one of before this question."""


class Holdings:
    """Finds journals that the server lacks, and has them copied again.

    ``contact`` numbers the connections, None while there is none. ``step`` is for the thread that
    copies; the other methods are for any.
    """

    def __init__(self, copier: Copier, contact: Callable[[], int | None]) -> None:
        self._copier = copier
        self._contact = contact
        self._asked: int | None = None

    def look_again(self) -> None:
        """Ask once more: somebody wants journals of this robot."""
        self._asked = None

    def may_lack(self, name: str) -> bool:
        """Tell whether a confirmed journal is, or may be, missing on the server."""
        return self._asked is None or name in self._copier.lacking

    def step(self) -> None:
        """Ask if there is a connection for which that was not done.

        Raises CopyError for another time, OSError when the disk does not take what is found.
        """
        contact = self._contact()
        if contact is None or contact == self._asked:
            return
        self._asked = contact  # before it is asked: look_again may come meanwhile
        try:
            for asked in holdings.questions(holdings.stretches_of(self._counted_on())):
                answer = self._ask(asked)
                if answer is None:
                    return
                lacking = holdings.lacking(asked, answer)
                if lacking:
                    self._copier.copy_again(lacking)
        except BaseException:
            self._asked = None
            raise

    def _counted_on(self) -> Iterator[Copy]:
        """Give the journals that are here and that the server has taken, or has refused."""
        copier = self._copier
        confirmed = manifest.read(copier.store.path).confirmed - copier.lacking
        for writer in FOLDERS:
            for path in copier.store.journal_files(writer):
                name = f"{path.parent.name}/{path.name}"
                if name in confirmed or name in copier.quarantined:
                    try:
                        yield Copy(name, path.stat().st_size, name in confirmed)
                    except FileNotFoundError:  # deleted meanwhile
                        continue

    def _ask(self, asked: Sequence[tuple[Stretch, list[Copy]]]) -> Answer | None:
        """Ask about some stretches; None from a server that does not know the question."""
        copier = self._copier
        question = Question([stretch for stretch, _ in asked])
        headers = {"Content-Type": "application/x-msgpack"}
        address = holdings.address(copier.store.id)
        reply = copier.send("POST", address, headers, msgspec.msgpack.encode(question))
        if reply.status in _UNKNOWN:
            return None
        if reply.status != 200:
            raise CopyError(f"the server answers {reply.status} {reply.body[:200]!r}")
        try:
            return msgspec.msgpack.decode(reply.body, type=Answer)
        except msgspec.MsgspecError as error:
            raise CopyError(f"what the server holds cannot be read: {error}") from error
