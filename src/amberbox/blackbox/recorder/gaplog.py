"""Gap records: from when to when nothing of a publisher could be heard, and why."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from amberbox.blackbox.recorder.streams import Drops

Write = Callable[[dict[str, Any]], None]


_PAUSED = "the box was not recording"
_NOT_CONNECTED = "publisher not connected yet"


@dataclass
class GapLog:
    """Keeps the gaps that are open, per item and peer, and writes each as it opens and closes.

    The record of the opening has ``to_ns`` null: should the box die, the gap lasts at least to
    the end of its record, and the next run opens its own from there.
    """

    write: Write
    start_ns: int
    _open: dict[tuple[str, str], tuple[int, str]] = field(default_factory=dict)
    _known: set[tuple[str, str]] = field(default_factory=set)
    _paused: bool = False

    def __post_init__(self) -> None:
        self._lock = threading.Lock()

    def pause(self, now_ns: int) -> None:
        """Write that nobody recorded since the end of the run before, whatever the item."""
        self._paused = True
        self._write("", "", self.start_ns, now_ns, _PAUSED)

    def expect(self, item: str) -> None:
        """Open the gap that every configured item has until its first publisher is heard."""
        with self._lock:
            self._begin(item, "", self.start_ns, self._not_connected)

    @property
    def _not_connected(self) -> str:
        return f"{_PAUSED}, then {_NOT_CONNECTED}" if self._paused else _NOT_CONNECTED

    def up(self, item: str, peer: str, now_ns: int, since_ns: int | None) -> None:
        """Close what is open for a peer; for a new one write what it may have said before."""
        with self._lock:
            closed = self._end(item, "", now_ns)
            closed |= self._end(item, peer, now_ns)
            new = (item, peer) not in self._known
            self._known.add((item, peer))
            if new and not closed:
                start = self.start_ns if since_ns is None else max(since_ns, self.start_ns)
                reason = self._not_connected if start == self.start_ns else _NOT_CONNECTED
                self._write(item, peer, start, now_ns, reason)

    def down(self, item: str, peer: str, now_ns: int, reason: str) -> None:
        """Open a gap for a peer that was lost."""
        with self._lock:
            self._known.add((item, peer))
            self._begin(item, peer, max(now_ns, self.start_ns), reason)

    def dropping(self, item: str, from_ns: int, reason: str) -> None:
        """Write that the box itself drops an item from now on; ``dropped`` tells the end."""
        self._write(item, "", from_ns, None, f"dropped: {reason}")

    def dropped(self, item: str, drops: Drops, reason: str) -> None:
        """Write what the box itself had to drop."""
        first_ns, last_ns, count = drops
        self._write(item, "", first_ns, last_ns + 1, f"dropped: {reason}", count)

    def lost(self, item: str, peer: str, from_ns: int, to_ns: int, reason: str, count: int) -> None:
        """Write that messages were lost between two that arrived."""
        self._write(item, peer, from_ns, to_ns, reason, count)

    def shift(self, step_ns: int) -> None:
        """Move the beginnings of what is open: log time has begun anew."""
        with self._lock:
            self.start_ns += step_ns
            self._open = {
                key: (from_ns + step_ns, reason) for key, (from_ns, reason) in self._open.items()
            }

    def close(self, now_ns: int) -> None:
        """End everything that is open: the run is over."""
        with self._lock:
            for (item, peer), (from_ns, reason) in self._open.items():
                self._write(item, peer, from_ns, now_ns, reason)
            self._open.clear()

    def _begin(self, item: str, peer: str, from_ns: int, reason: str) -> None:
        if (item, peer) not in self._open:
            self._open[item, peer] = (from_ns, reason)
            self._write(item, peer, from_ns, None, reason)

    def _end(self, item: str, peer: str, now_ns: int) -> bool:
        opened = self._open.pop((item, peer), None)
        if opened is not None:
            self._write(item, peer, opened[0], now_ns, opened[1])
        return opened is not None

    def _write(
        self,
        item: str,
        peer: str,
        from_ns: int,
        to_ns: int | None,
        reason: str,
        count: int | None = None,
    ) -> None:
        self.write(
            {
                "item": item,
                "peer": peer,
                "from_ns": from_ns,
                "to_ns": to_ns,
                "reason": reason,
                "count": count,
            }
        )
