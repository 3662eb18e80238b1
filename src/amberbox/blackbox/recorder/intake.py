"""The recorder's queue: bounded, never in a source's way, every drop counted."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from amberbox.blackbox.recorder.streams import Drops, Item, Stream

_OVERHEAD = 120
"""Bytes a queued message takes beside its payload."""


@dataclass
class Intake:
    """Holds messages between the sources' threads and the writer."""

    limit_bytes: int
    wake: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._room = threading.Condition()
        self._queue: list[tuple[Stream, bytes, int]] = []
        self._bytes = 0
        self._waiting_bytes = 0
        self._waits_no_more = False

    def put(self, stream: Stream, data: bytes, received_ns: int) -> None:
        """Take a message, or drop and count it when the queue is full. Never waits."""
        size = len(data) + _OVERHEAD
        with self._room:
            stream.counters.received += 1
            stream.counters.last_received_ns = received_ns
            if self._bytes + self._waiting_bytes + size > self.limit_bytes:
                stream.drop(received_ns)
                return
            self._bytes += size
            self._queue.append((stream, data, received_ns))

    def put_waiting(self, stream: Stream, data: bytes, received_ns: int) -> None:
        """Take a message of a file: wait for room, until ``wait_no_more``, instead of dropping."""
        size = len(data) + _OVERHEAD
        with self._room:
            while self._is_full_for(size):
                if self._waits_no_more:
                    return
                self.wake.set()
                self._room.wait(1.0)
            stream.counters.received += 1
            stream.counters.last_received_ns = received_ns
            self._bytes += size
            self._queue.append((stream, data, received_ns))

    def _is_full_for(self, size: int) -> bool:
        """Tell whether there is no room; there always is for one message, however large."""
        used = self._bytes + self._waiting_bytes
        return used > 0 and used + size > self.limit_bytes

    def wait_no_more(self) -> None:
        """Send those away who wait for room, for the recording ends."""
        with self._room:
            self._waits_no_more = True
            self._room.notify_all()

    def refuse(self, messages: Iterable[tuple[Item, int]], reason: str) -> None:
        """Count messages that were taken, and then found no room on the disk."""
        with self._room:
            for item, received_ns in messages:
                item.drop(received_ns, reason)

    def count_lost(self, item: Item, count: int) -> None:
        """Count messages that a source found missing among those that came."""
        with self._room:
            item.counters.lost += count

    def take_drops(self, item: Item) -> dict[str, Drops]:
        """Return what was dropped of an item since the last call, by reason."""
        with self._room:
            drops, item.drops = item.drops, {}
        return drops

    def shift_drops(self, items: Iterable[Item], step_ns: int) -> None:
        """Move the times of what was dropped: log time has begun anew."""
        with self._room:
            for item in items:
                for reason, (first_ns, last_ns, count) in item.drops.items():
                    item.drops[reason] = (first_ns + step_ns, last_ns + step_ns, count)

    @property
    def longest_bytes(self) -> int:
        """Bytes of the longest message that the empty queue takes."""
        return max(0, self.limit_bytes - _OVERHEAD)

    @property
    def size_bytes(self) -> int:
        """Bytes that wait, the ones being written included."""
        return self._bytes + self._waiting_bytes

    def take(self) -> list[tuple[Stream, bytes, int]]:
        """Take everything off the queue; its bytes count until ``release``."""
        with self._room:
            taken, self._queue = self._queue, []
            self._waiting_bytes += self._bytes
            self._bytes = 0
        return taken

    def give_back(self, messages: Sequence[tuple[Stream, bytes, int]]) -> None:
        """Put messages back to the front of the queue, as if they had not been taken."""
        with self._room:
            self._queue[:0] = messages
            self._bytes += sum(len(data) + _OVERHEAD for _, data, _ in messages)

    def release(self) -> None:
        """Say that what was taken has been written."""
        with self._room:
            self._waiting_bytes = 0
            self._room.notify_all()
