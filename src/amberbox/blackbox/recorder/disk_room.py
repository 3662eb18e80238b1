"""Disk room of the record: the reserve for the last events, and admission while only events fit."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.blackbox.recorder.queue import DataItem, Drops, EmitEvent, MessageQueue, StreamMessage
from amberbox.blackbox.retention.usage import Allowance
from amberbox.core.clock import NS

RESERVE = "reserve"  # file in the store that reserves room for the last events
# file in the store by which the retention service forbids recording; it holds the reason
FULL = "full"
DISK_FULL = "disk full"
USED_UP = "the room is used up that the keeper had stated"
SPARE_BYTES = 4_000_000  # room needed beside the reserve before recording continues
_PAUSE_S = 10.0  # pause after a failed attempt to allocate the reserve
_TIGHT_BYTES = 256_000  # with less free than this even a run's first records would not fit


class DiskRoom:
    """The reserve of a store, and whether everything is recorded or only events.

    An empty reserve file states, also to the next run, that the reserve has been released.
    """

    def __init__(self, store: Path, reserve_bytes: int) -> None:
        self.reason = ""  # why only events are recorded; empty while everything is
        # why the reserve cannot be allocated on a disk that is not full; empty if it can
        self.trouble = ""
        self._store = store
        self._path = store / RESERVE
        self._wanted_bytes = reserve_bytes
        self._not_before_s = 0.0
        self._allowance = Allowance(store)

    @property
    def spared_bytes(self) -> int:
        """Return the bytes of each journal's waiting messages that may use the reserve."""
        return self._wanted_bytes // 8

    def begin(self) -> None:
        """Allocate the reserve, unless the previous run released it or there is too
        little space.
        """
        self.release_if_tight()
        self.update()
        short = self._wanted_bytes - (self._size() or 0)
        if short > 0 and not self.reason and not self.trouble:
            self.trouble = "too little room is free"

    def update(self, written_bytes: int = 0, coming_bytes: int = 0) -> None:
        """Update ``reason``: whether there is space for the next ``coming_bytes``.

        ``written_bytes`` are those that this run has written so far.
        """
        left = self._allowance.left_bytes(written_bytes)
        if self._wanted_bytes:
            self._refill(left)
        dropped = self._wanted_bytes > 0 and self._size() == 0
        is_used_up = left is not None and left < self._least_bytes(coming_bytes)
        self.reason = DISK_FULL if dropped else self._forbidden() or USED_UP * is_used_up

    def _least_bytes(self, coming_bytes: int) -> int:
        """Return the bytes that must be left of the allowance; more to begin recording again."""
        if self.reason != USED_UP:
            return coming_bytes
        return max(coming_bytes, self._allowance.enough_bytes)

    def release(self) -> bool:
        """Release the reserve for the last events; False if there is none."""
        if not self._size():
            return False
        try:
            os.truncate(self._path, 0)
        except OSError:
            return False
        self.reason = DISK_FULL
        return True

    def release_if_tight(self) -> None:
        """Release the reserve if almost nothing is free beside it."""
        free = free_bytes(self._store)
        if free is not None and free < _TIGHT_BYTES:
            self.release()

    def _refill(self, left_bytes: int | None) -> None:
        """Allocate the whole reserve once there is space for it and ``SPARE_BYTES`` more."""
        size = self._size() or 0
        if left_bytes is not None and left_bytes < self._wanted_bytes - size:
            return
        if size >= self._wanted_bytes or time.monotonic() < self._not_before_s:
            return
        free = free_bytes(self._store)
        if free is not None and free < self._wanted_bytes - size + SPARE_BYTES:
            return
        self.trouble = _allocate(self._path, size, self._wanted_bytes)
        self._not_before_s = time.monotonic() + _PAUSE_S if self.trouble else 0.0

    def _size(self) -> int | None:
        """Return the size of the reserve; None if it was never allocated."""
        try:
            return self._path.stat().st_size
        except OSError:
            return None

    def _forbidden(self) -> str:
        """Return why the retention service allows only events; empty if it allows everything."""
        try:
            why = (self._store / FULL).read_text(errors="replace").strip()
        except OSError:
            return ""
        return f"store is full ({why})" if why else "store is full"


def _allocate(path: Path, size: int, wanted_bytes: int) -> str:
    """Allocate blocks for a file up to a size; return the error text, empty on success."""
    existed = path.exists()
    try:
        with path.open("ab") as file:
            os.posix_fallocate(file.fileno(), 0, wanted_bytes)
    except OSError as error:
        with suppress(OSError):
            os.truncate(path, size) if existed else path.unlink()
        return error.strerror or str(error)
    return ""


def free_bytes(folder: Path) -> int | None:
    """Return the bytes free for unprivileged users; None if the file system does not state it."""
    try:
        status = os.statvfs(folder)
    except OSError:
        return None
    return status.f_bavail * status.f_frsize if status.f_blocks else None


Write = Callable[[dict[str, Any]], None]


_PAUSED = "the box was not recording"
_NOT_CONNECTED = "publisher not connected yet"


@dataclass
class GapLog:
    """The open gaps per item and peer; writes a record when one opens and when it closes.

    The record of the opening has ``to_ns`` null: if the box dies, the gap lasts at least to the end
    of its record, and the next run opens its own from there.
    """

    write: Write
    start_ns: int
    _open: dict[tuple[str, str], tuple[int, str]] = field(default_factory=dict)
    _known: set[tuple[str, str]] = field(default_factory=set)
    _paused: bool = False

    def __post_init__(self) -> None:
        self._lock = threading.Lock()

    def pause(self, now_ns: int) -> None:
        """Write a gap of all items since the end of the run before."""
        self._paused = True
        self._write("", "", self.start_ns, now_ns, _PAUSED)

    def expect(self, item: str) -> None:
        """Open the gap that every configured item has until its first publisher connects."""
        with self._lock:
            self._begin(item, "", self.start_ns, self._not_connected)

    @property
    def _not_connected(self) -> str:
        return f"{_PAUSED}, then {_NOT_CONNECTED}" if self._paused else _NOT_CONNECTED

    def up(self, item: str, peer: str, now_ns: int, since_ns: int | None) -> None:
        """Close the gaps of a peer; for a new peer write the gap before its connection."""
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
        """Write that the box drops messages of an item from now on; ``dropped`` writes the end."""
        self._write(item, "", from_ns, None, f"dropped: {reason}")

    def dropped(self, item: str, drops: Drops, reason: str) -> None:
        """Write a gap of messages that the box dropped."""
        first_ns, last_ns, count = drops
        self._write(item, "", first_ns, last_ns + 1, f"dropped: {reason}", count)

    def lost(self, item: str, peer: str, from_ns: int, to_ns: int, reason: str, count: int) -> None:
        """Write a gap of messages lost between two that arrived."""
        self._write(item, peer, from_ns, to_ns, reason, count)

    def shift(self, step_ns: int) -> None:
        """Move the starts of open gaps to a new epoch of log time by ``step_ns``."""
        with self._lock:
            self.start_ns += step_ns
            self._open = {
                key: (from_ns + step_ns, reason) for key, (from_ns, reason) in self._open.items()
            }

    def close(self, now_ns: int) -> None:
        """Close all gaps at the end of the run."""
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


# shortest and longest interval of writing drops, so that the room left for events lasts
ACCOUNT_NS = (NS, 60 * NS)


@dataclass
class AdmissionControl:
    """Refuses messages while there is no space on the disk, and counts every one of them.

    Items of the ``elsewhere`` writers are on another disk and are still recorded. The last message
    of a latched topic is held back and recorded when there is space, as it is not sent again.
    """

    room: DiskRoom
    queue: MessageQueue
    gaps: GapLog
    emit: EmitEvent
    elsewhere: Collection[str] = ()
    _reported: str = ""
    _reported_trouble: str = ""
    _dropped: Counter[str] = field(default_factory=Counter)
    _held: dict[int, StreamMessage] = field(default_factory=dict)
    _account_at_ns: int | None = None
    _account_pause_ns: int = ACCOUNT_NS[0]
    _ends: bool = False

    def requeue_files(self, taken: list[StreamMessage], written_bytes: int) -> list[StreamMessage]:
        """Update the room; without any, requeue messages of files and return the others."""
        self.room.update(written_bytes, self.queue.size_bytes)
        self.report()
        if not self.room.reason or self._ends:
            return taken
        self.queue.give_back([message for message in taken if message[0].item.waits])
        return [message for message in taken if not message[0].item.waits]

    def admit(self, messages: list[StreamMessage], now_ns: int) -> list[StreamMessage]:
        """Return the messages that may be recorded; count the others as dropped."""
        if not self.room.reason:
            return [*self._held_messages(messages, now_ns), *messages]
        admitted = [m for m in messages if m[0].item.writer in self.elsewhere]
        refused = [m for m in messages if m[0].item.writer not in self.elsewhere]
        self.refuse(self._hold_latched(refused), self.room.reason)
        return admitted

    def _held_messages(self, messages: Sequence[StreamMessage], now_ns: int) -> list[StreamMessage]:
        """Return the messages that were held back, as if received now."""
        at_ns = messages[0][2] if messages else now_ns
        held, self._held = self._held, {}
        return [(stream, data, at_ns) for stream, data, _ in held.values()]

    def _hold_latched(self, refused: Iterable[StreamMessage]) -> list[tuple[DataItem, int]]:
        """Hold back the last message of each latched stream; return item and time of the others."""
        dropped = []
        for message in refused:
            replaced: StreamMessage | None = message
            if message[0].topic.latched:
                replaced = self._held.get(id(message[0]))
                self._held[id(message[0])] = message
            dropped += [] if replaced is None else [replaced]
        if self._ends:
            dropped += self._held.values()
            self._held = {}
        return [(stream.item, received_ns) for stream, _, received_ns in dropped]

    def refuse(self, messages: Sequence[tuple[DataItem, int]], reason: str) -> None:
        """Count messages as dropped; the first of an item opens its gap."""
        firsts = {item.name: (item, received_ns) for item, received_ns in reversed(messages)}
        for item, received_ns in firsts.values():
            if reason not in item.drops:
                self.gaps.dropping(item.name, received_ns, reason)
        self._dropped.update(item.name for item, _ in messages)
        self.queue.refuse(messages, reason)

    def report(self) -> None:
        """Emit an event when the space is used up, or available again."""
        reason, trouble = self.room.reason, self.room.trouble
        if trouble and trouble != self._reported_trouble:
            self.emit("no_reserve", f"there is no reserve for the last events: {trouble}")
        self._reported_trouble = trouble
        if reason == self._reported:
            return
        self._reported = reason
        if reason:
            self.emit("events_only", f"{reason}: only events are recorded until there is room")
            return
        total, items = self._dropped.total(), len(self._dropped)
        text = f"there is room: recording goes on; {total} messages of {items} items were dropped"
        self.emit("recording_resumed", text, dropped=dict(self._dropped))
        self._dropped.clear()

    def account_due(self, now_ns: int) -> bool:
        """Return whether counters and drops are to be written now."""
        if not self.room.reason or self._ends:
            self._account_at_ns, self._account_pause_ns = None, ACCOUNT_NS[0]
            return True
        if self._account_at_ns is None:
            self._account_at_ns = now_ns + self._account_pause_ns
        if now_ns < self._account_at_ns:
            return False
        self._account_pause_ns = min(2 * self._account_pause_ns, ACCOUNT_NS[1])
        self._account_at_ns = now_ns + self._account_pause_ns
        return True

    def end(self) -> None:
        """End the run: messages held back are dropped, and all drops are written."""
        self._ends = True
