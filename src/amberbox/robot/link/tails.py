"""A writer's conclusions as they stand in its journal, byte for byte, from a position on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from amberbox.blackbox.follow.tail import Delivery, WriterTail
from amberbox.blackbox.journal.chunk import Chunk
from amberbox.blackbox.journal.clocktable import ClockTable
from amberbox.blackbox.store import Store
from amberbox.core.types import IntArray, WriterCursor
from amberbox.link import limits
from amberbox.link.frames import Row
from amberbox.link.positions import Place

ITEMS = frozenset(channel.replace("/", "_") for channel in limits.CHANNELS)
"""Items whose rows go over the link."""


class RawTail(WriterTail):
    """Gives a writer's rows undecoded; otherwise it follows as everybody does.

    Rows of journals that were deleted before they were read do not come: what is left of them is
    columns. ``too_large`` counts rows that no frame can take; they come with their journal.
    """

    def __init__(self, store: Store, writer: str, start: Place) -> None:
        super().__init__(store, writer, ITEMS, WriterCursor(start.run, start.seq))
        self._found: list[Row] = []
        self._stepping: Iterator[Delivery] | None = None
        self.too_large = 0

    @property
    def place(self) -> Place:
        """How far all rows have been given."""
        return Place(self.run, self.seq)

    def pull(self, most: int) -> list[Row]:
        """Read on until there are ``most`` rows or more, or nothing new; return them in order."""
        if self._stepping is None:
            self._stepping = self.step()
        for _ in self._stepping:
            if len(self._found) >= most:
                break
        else:
            self._stepping = None
        found, self._found = self._found, []
        return sorted(found, key=lambda row: row.place)

    def _item_rows(
        self,
        item: str,
        rows: IntArray,
        chunk: Chunk,
        seq: IntArray,
        clock: ClockTable,
        streams: Any,
    ) -> Iterator[Delivery]:
        """Take the rows of an item in a chunk as they are; nothing is unrolled."""
        numbers, times = seq[rows].tolist(), chunk.log_ns[rows].tolist()
        channels = [streams[n].topic.name for n in chunk.channel[rows].tolist()]
        for number, at_ns, channel, data in zip(
            numbers, times, channels, chunk.messages(rows), strict=True
        ):
            if len(data) > limits.ROW_BYTES:
                self.too_large += 1
            elif channel in limits.CHANNELS:
                self._found.append(Row(self.writer, self.run, number, channel, at_ns, data))
        if numbers:
            self.ahead[item] = numbers[-1] + 1
        yield from ()
