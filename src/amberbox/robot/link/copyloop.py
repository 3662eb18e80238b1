"""The thread that copies journals, one after the other, while there is a link and a reason to."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.core.errors import AmberboxError
from amberbox.link.backoff import Backoff
from amberbox.robot.link.copying import Copier, CopyError
from amberbox.robot.link.fetching import Requests
from amberbox.robot.link.holdings import Holdings

POLL_S = 2.0


@dataclass(slots=True)
class CopyLoop:
    """Copies what is due; ``before`` is done first each time, for what else goes by HTTP.

    ``may_copy`` tells whether anything may be copied now.
    """

    copier: Copier
    requests: Requests
    before: Callable[[], None]
    may_copy: Callable[[], bool]
    holdings: Holdings | None = None
    backoff: Backoff = field(default_factory=Backoff)
    trouble: str = ""
    copied: int = 0
    wake: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Work until the copier's ``stop`` is set."""
        stop = self.copier.stop
        while not stop.is_set():
            try:
                worked = self.step()
            except (CopyError, AmberboxError, OSError) as error:
                self.trouble = str(error).splitlines()[0]
                stop.wait(self.backoff.failed())
            else:
                self.backoff.succeeded()
                self.trouble = ""
                self._rest(worked=worked)

    def step(self) -> bool:
        """Do the next thing; tell whether there was one. Raises what may pass by itself."""
        self.requests.step()
        trouble = self._look_at_holdings()
        worked = False
        if self.may_copy():
            self.before()
            worked = self.copier.step()
            self.copied += worked
        if trouble is not None:
            raise trouble  # after a copy: a question that is never answered does not stop them
        return worked

    def _look_at_holdings(self) -> CopyError | None:
        """See whether the server lacks what it had; return why that is not known."""
        try:
            if self.holdings is not None:
                self.holdings.step()
        except CopyError as error:
            return error
        return None

    def _rest(self, *, worked: bool) -> None:
        if not worked:
            self.wake.wait(POLL_S)
            self.wake.clear()
