"""Windows that somebody on the server wants: which journals hold them, until they are copied.

What was asked for is written down, so that a restart of the link does not forget it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
from msgspec import Struct

from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.incidents.extent import extent
from amberbox.blackbox.segments import manifest
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS
from amberbox.core.files import replace_file
from amberbox.link.frames import Fetch
from amberbox.robot.link.client import Found

FILE = "link-requests.json"
WRITERS = ("main", "bulk", "ring", "watch", "keep")
_MARGIN_NS = 2 * NS
"""Corrected times may differ from those in a journal by smaller steps of the wall clock."""
_MOST = 200
"""Requests that are remembered; of more the oldest are let go, the server asks again."""


class Request(Struct, frozen=True):
    """A window that was asked for, by times of receipt; ``item`` is empty for all."""

    id: str
    item: str
    from_ns: int
    to_ns: int


class Requests:
    """What was asked for and is not copied yet; ``add`` from any thread, ``step`` from one."""

    def __init__(
        self,
        store: Store,
        answer: Callable[[Found], None],
        wall_ns: Callable[[], int],
        is_settled: Callable[[str], bool] = lambda name: False,
        lacks: Callable[[str], bool] = lambda name: False,
    ) -> None:
        self._store, self._answer = store, answer
        self._wall_ns, self._is_settled, self._lacks = wall_ns, is_settled, lacks
        self._lock = threading.Lock()
        self._open: dict[str, Request] = {r.id: r for r in _read(store.path / FILE)}
        self._told: dict[str, tuple[tuple[str, int], ...]] = {}
        self._asked_again: set[str] = set()
        self.journals: frozenset[str] = frozenset()
        """What is to be copied whatever the rule says."""

    def add(self, frame: Fetch) -> None:
        """Take a request; the answer to it comes with the next step."""
        with self._lock:
            self._open[frame.id] = Request(frame.id, frame.item, frame.from_ns, frame.to_ns)
            for old in list(self._open)[:-_MOST]:
                del self._open[old]
            self._asked_again.add(frame.id)

    def step(self) -> None:
        """Find the journals of what was asked for, answer, and let go of what is done.

        Raises OSError when the disk does not take what is open.
        """
        with self._lock:
            again, self._asked_again = self._asked_again, set()
            requests = list(self._open.values())
        if again:
            self._write(requests)
        said = manifest.read(self._store.path)
        wanted: set[str] = set()
        for request in requests:
            files = self._look(request, said, is_news=request.id in again)
            wanted |= {name for name, _ in files}
            if self._is_done(request, files, said):
                self._let_go(request)
        self.journals = frozenset(wanted)

    def _look(
        self, request: Request, said: Manifest, *, is_news: bool
    ) -> tuple[tuple[str, int], ...]:
        files = tuple(journals_of(self._store, request, said))
        told = {name for name, _ in self._told.get(request.id, ())}
        if is_news or {name for name, _ in files} != told:
            self._told[request.id] = files
            self._answer(Found(request.id, files))
        return files

    def _is_done(
        self, request: Request, files: tuple[tuple[str, int], ...], said: Manifest
    ) -> bool:
        """Tell whether the window has passed, and each of its journals has had its turn."""
        if request.to_ns + _MARGIN_NS > self._wall_ns() and is_locked(self._store, "main"):
            return False
        return all(
            (name in said.confirmed and not self._lacks(name)) or self._is_settled(name)
            for name, _ in files
        )

    def _let_go(self, request: Request) -> None:
        with self._lock:
            if request.id in self._asked_again:
                return
            self._open.pop(request.id, None)
            requests = list(self._open.values())
        self._told.pop(request.id, None)
        self._write(requests)

    def _write(self, requests: list[Request]) -> None:
        replace_file(self._store.path / FILE, msgspec.json.encode(requests).decode())


def journals_of(store: Store, request: Request, said: Manifest) -> Iterator[tuple[str, int]]:
    """Give the journals, name and bytes, that hold rows of a window; open ones are among them."""
    item = request.item.partition("__")[0]
    for writer in WRITERS:
        for path in store.journal_files(writer):
            name = f"{path.parent.name}/{path.name}"
            span = _span(path, name, said)
            meets = span is not None and span[0] <= request.to_ns and span[1] >= request.from_ns
            if meets and (not item or item in _items(path, name)):
                yield name, _size(path)


def _span(path: Path, name: str, said: Manifest) -> tuple[int, int] | None:
    """Return from when to when a journal was received, rather too much; None without rows."""
    sealed = said.sealed.get(name)
    if sealed is not None:
        return sealed.start_ns - _MARGIN_NS, sealed.end_ns + _MARGIN_NS
    found = extent(path)
    if found is None:
        return None
    offset_ns = found.offset_ns
    return found.start_ns + offset_ns - _MARGIN_NS, found.end_ns + offset_ns + _MARGIN_NS


def _items(path: Path, name: str) -> frozenset[str]:
    try:
        return frozenset(journal_file(path, name).items)
    except FileNotFoundError:  # deleted meanwhile
        return frozenset()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _read(path: Path) -> list[Request]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[Request])
    except (OSError, msgspec.MsgspecError):
        return []
