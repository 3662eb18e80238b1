"""Message rows of a malformed SQLite file, read from its pages without SQLite.

A row is believed if it lies in a table leaf page and looks like one of rosbag2's messages: a row
number, a topic number, a time and bytes (https://www.sqlite.org/fileformat2.html).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from amberbox.blackbox.formats.bytesource import ByteSource

_LEAF = 0x0D
_INTEGER_BYTES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
_SMALLEST_BLOB = 12  # serial types 12, 14, ... are blobs of 0, 1, ... bytes


class Row(NamedTuple):
    """One message row."""

    number: int
    topic: int
    timestamp_ns: int
    data: bytes


class Leaf(NamedTuple):
    """A page that holds message rows, and what they span."""

    page: int
    first_row: int
    last_row: int
    start_ns: int
    end_ns: int
    messages: int


@dataclass(frozen=True)
class Pages:
    """The pages of a database file; ``usable`` bytes of each carry data."""

    source: ByteSource
    size: int
    usable: int

    def read(self, number: int) -> bytes:
        """Return a page by its number from 1 on; short where the file ends."""
        return self.source.read((number - 1) * self.size, self.size)


def open_pages(source: ByteSource) -> Pages:
    """Read the page size from the file's header."""
    header = source.read(0, 100).ljust(100, b"\0")
    size = int.from_bytes(header[16:18], "big")
    size = 65536 if size == 1 else size
    if size < 512 or size & (size - 1):
        size = 4096  # SQLite's default, where the header is damaged
    return Pages(source, size, size - header[20])


def find_leaves(pages: Pages) -> Iterator[Leaf]:
    """Look at every page of the file for message rows."""
    for number in range(2, pages.source.size // pages.size + 1):
        rows = rows_of(pages, number)
        if rows:
            numbers, times = [r.number for r in rows], [r.timestamp_ns for r in rows]
            span = min(numbers), max(numbers), min(times), max(times)
            yield Leaf(number, *span, len(rows))


def missing_rows(leaves: list[Leaf]) -> list[tuple[int, int]]:
    """Return the ranges of row numbers between the leaves that no leaf holds."""
    if not leaves:
        return []
    spans = np.array(sorted((leaf.first_row, leaf.last_row) for leaf in leaves), np.int64)
    reached = np.maximum.accumulate(spans[:, 1])
    holes = np.flatnonzero(spans[1:, 0] > reached[:-1] + 1)
    before = [(1, int(spans[0, 0]) - 1)] if spans[0, 0] > 1 else []
    return before + [(int(reached[i]) + 1, int(spans[i + 1, 0]) - 1) for i in holes]


def rows_of(pages: Pages, number: int) -> list[Row]:
    """Read the message rows of a page; none if it is not a leaf of messages."""
    page = pages.read(number)
    if len(page) < pages.size or page[0] != _LEAF:
        return []
    count = int.from_bytes(page[3:5], "big")
    if 8 + 2 * count > pages.usable:
        return []
    pointers = np.frombuffer(page, ">u2", count, 8).tolist()
    rows = (_row_at(pages, page, pointer) for pointer in pointers)
    return [row for row in rows if row is not None]


def _row_at(pages: Pages, page: bytes, at: int) -> Row | None:
    try:
        size, at = _varint(page, at)
        number, at = _varint(page, at)
        payload = _payload(pages, page, at, size)
        return _parse_row(number, payload) if payload is not None else None
    except IndexError:
        return None


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Read SQLite's variable-length integer; returns value and next offset."""
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _payload(pages: Pages, page: bytes, at: int, size: int) -> bytes | None:
    """Collect a row's bytes, following its overflow pages."""
    if size > pages.source.size:
        return None
    local = _local_size(pages.usable, size)
    pieces, missing = [page[at : at + local]], size - local
    next_page = int.from_bytes(page[at + local : at + local + 4], "big")
    while missing > 0:
        overflow = pages.read(next_page) if next_page else b""
        if len(overflow) < pages.size:
            return None
        pieces.append(overflow[4 : 4 + min(missing, pages.usable - 4)])
        missing -= len(pieces[-1])
        next_page = int.from_bytes(overflow[:4], "big")
    return b"".join(pieces)


def _local_size(usable: int, size: int) -> int:
    if size <= usable - 35:
        return size
    smallest = (usable - 12) * 32 // 255 - 23
    fitting = smallest + (size - smallest) % (usable - 4)
    return fitting if fitting <= usable - 35 else smallest


def _parse_row(number: int, payload: bytes) -> Row | None:
    header_size, at = _varint(payload, 0)
    kinds = []
    while at < header_size:
        kind, at = _varint(payload, at)
        kinds.append(kind)
    if len(kinds) != 4 or kinds[0] != 0 or not _is_message(kinds):
        return None
    topic, at = _integer(payload, at, kinds[1])
    timestamp, at = _integer(payload, at, kinds[2])
    data = payload[at:]
    if len(data) != (kinds[3] - _SMALLEST_BLOB) // 2:
        return None
    return Row(number, topic, timestamp, data)


def _is_message(kinds: list[int]) -> bool:
    integers = all(1 <= kind <= 9 and kind in _INTEGER_BYTES for kind in kinds[1:3])
    return integers and kinds[3] >= _SMALLEST_BLOB and kinds[3] % 2 == 0


def _integer(payload: bytes, at: int, kind: int) -> tuple[int, int]:
    if kind in (8, 9):
        return kind - 8, at
    end = at + _INTEGER_BYTES[kind]
    return int.from_bytes(payload[at:end], "big", signed=True), end
