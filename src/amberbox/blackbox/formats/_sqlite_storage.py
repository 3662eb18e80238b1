"""The SQLite files of ROS 2 bags (.db3), whole or damaged: a row that can be read is read.

Messages are read in ranges of row numbers, which is the order they were written in. Where SQLite
calls the database malformed, the rows are taken from its pages: a row is believed if it lies in a
table leaf page and looks like one of rosbag2's messages: a row number, a topic number, a time and
bytes (https://www.sqlite.org/fileformat2.html).
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from amberbox.blackbox.formats._recording import (
    ByteSource,
    FileBytes,
    RecordedMessage,
    RecordingDamage,
    RecordingPart,
    RecordingReport,
    TopicTable,
)
from amberbox.blackbox.formats._ros2_types import Ros2Definitions, is_latched
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

_LEAF = 0x0D
_INTEGER_BYTES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 8: 0, 9: 0}
_SMALLEST_BLOB = 12  # serial types 12, 14, ... are blobs of 0, 1, ... bytes


class MessageRow(NamedTuple):
    """One message row."""

    number: int
    topic: int
    timestamp_ns: int
    data: bytes


class LeafPage(NamedTuple):
    """A page of message rows, and the ranges of their numbers and times."""

    page: int
    first_row: int
    last_row: int
    start_ns: int
    end_ns: int
    messages: int


@dataclass(frozen=True)
class DatabasePages:
    """The pages of a database file; ``usable`` bytes of each carry data."""

    source: ByteSource
    size: int
    usable: int

    def read(self, number: int) -> bytes:
        """Return a page by its number from 1 on; short where the file ends."""
        return self.source.read((number - 1) * self.size, self.size)


def open_pages(source: ByteSource) -> DatabasePages:
    """Read the page size from the file's header."""
    header = source.read(0, 100).ljust(100, b"\0")
    size = int.from_bytes(header[16:18], "big")
    size = 65536 if size == 1 else size
    if size < 512 or size & (size - 1):
        size = 4096  # SQLite's default, where the header is damaged
    return DatabasePages(source, size, size - header[20])


def find_leaves(pages: DatabasePages) -> Iterator[LeafPage]:
    """Yield every page of the file that has message rows."""
    for number in range(2, pages.source.size // pages.size + 1):
        rows = rows_of(pages, number)
        if rows:
            numbers, times = [r.number for r in rows], [r.timestamp_ns for r in rows]
            span = min(numbers), max(numbers), min(times), max(times)
            yield LeafPage(number, *span, len(rows))


def missing_rows(leaves: list[LeafPage]) -> list[tuple[int, int]]:
    """Return the ranges of row numbers between the leaves that no leaf holds."""
    if not leaves:
        return []
    spans = np.array(sorted((leaf.first_row, leaf.last_row) for leaf in leaves), np.int64)
    reached = np.maximum.accumulate(spans[:, 1])
    holes = np.flatnonzero(spans[1:, 0] > reached[:-1] + 1)
    before = [(1, int(spans[0, 0]) - 1)] if spans[0, 0] > 1 else []
    return before + [(int(reached[i]) + 1, int(spans[i + 1, 0]) - 1) for i in holes]


def rows_of(pages: DatabasePages, number: int) -> list[MessageRow]:
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


def _row_at(pages: DatabasePages, page: bytes, at: int) -> MessageRow | None:
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


def _payload(pages: DatabasePages, page: bytes, at: int, size: int) -> bytes | None:
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


def _parse_row(number: int, payload: bytes) -> MessageRow | None:
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
    return MessageRow(number, topic, timestamp, data)


def _is_message(kinds: list[int]) -> bool:
    integers = all(1 <= kind <= 9 and kind in _INTEGER_BYTES for kind in kinds[1:3])
    return integers and kinds[3] >= _SMALLEST_BLOB and kinds[3] % 2 == 0


def _integer(payload: bytes, at: int, kind: int) -> tuple[int, int]:
    if kind in (8, 9):
        return kind - 8, at
    end = at + _INTEGER_BYTES[kind]
    return int.from_bytes(payload[at:end], "big", signed=True), end


MAGIC = b"SQLite format 3\0"
_ROWS = 2000
_PAGES = 128
_BEGINNING = 1 << 22
_SELECT = "SELECT id, topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ? ORDER BY id"


@dataclass
class BagDatabase:
    """An open .db3 file; the folder ``scratch`` is deleted when it is closed."""

    path: Path
    connection: sqlite3.Connection
    file: FileBytes
    report: RecordingReport
    cut_short: bool = False
    scratch: tempfile.TemporaryDirectory[str] | None = None
    leaves: list[LeafPage] | None = None

    def close(self) -> None:
        """Close the database and remove the files unpacked for it."""
        self.connection.close()
        self.file.close()
        if self.scratch is not None:
            self.scratch.cleanup()


def open_database(path: Path, report: RecordingReport) -> BagDatabase:
    """Open a .db3 file without writing to it or beside it."""
    scratch, place = None, path
    with path.open("rb") as file:
        header = file.read(100)
    page_size = int.from_bytes(header[16:18], "big")
    pages = int.from_bytes(header[28:32], "big")
    missing = max(0, (65536 if page_size == 1 else page_size) * pages - path.stat().st_size)
    if missing or any(p.exists() and p.stat().st_size for p in _journals(path)):
        scratch = tempfile.TemporaryDirectory(prefix="amberbox-")
        place = _stand_in(path, Path(scratch.name), missing)
        if missing:
            report.add_damage(
                RecordingDamage(path.name, path.stat().st_size, missing, "the file is cut short")
            )
        else:
            report.add_note(f"{path.name}: a journal of SQLite was replayed in a copy")
    uri = place.resolve().as_uri() + ("" if scratch else "?immutable=1")
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
    connection.text_factory = lambda text: text.decode(errors="replace")
    return BagDatabase(path, connection, FileBytes(path), report, bool(missing), scratch)


def _stand_in(path: Path, folder: Path, missing: int) -> Path:
    """Create a copy that SQLite may open.

    SQLite replays a journal when it opens a file; that must not happen in the original. It refuses
    a truncated file: then a sparse file of full length with the same beginning, where the topics
    are, replaces it; the messages are read from the original's pages.
    """
    place = folder / path.name
    if missing:
        with path.open("rb") as source:
            place.write_bytes(source.read(_BEGINNING))
        os.truncate(place, path.stat().st_size + missing)
        return place
    for file in (path, *_journals(path)):
        if file.exists():
            shutil.copyfile(file, folder / file.name)
    place.chmod(0o600)
    return place


def _journals(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ("-wal", "-journal")]


def distribution_of(database: BagDatabase) -> str:
    """Return the ROS distribution that wrote the file; empty if unknown."""
    rows = _query(database, "SELECT ros_distro FROM schema")
    return str(rows[0][0]).lower() if rows else ""


def add_topics(
    database: BagDatabase, table: TopicTable, definitions: Ros2Definitions
) -> dict[int, int]:
    """Add the topics of a file; returns topic index by the file's topic number."""
    try:
        rows = database.connection.execute("SELECT * FROM topics ORDER BY id")
        names = [column[0] for column in rows.description]
        topics = [dict(zip(names, row, strict=True)) for row in rows]
    except sqlite3.Error as error:
        raise AmberboxError(
            f"{database.path}: its topics cannot be read ({error})",
            "is it a ROS 2 bag? For a damaged one try: sqlite3 FILE .recover | sqlite3 NEW.db3",
        ) from None
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    inside = {
        str(name): Schema(str(name), str(encoding), str(text).encode())
        for name, encoding, text in _query(database, query)
        if text
    }
    return {int(row["id"]): table.add(_topic(database, row, inside, definitions)) for row in topics}


def _topic(
    database: BagDatabase,
    row: dict[str, Any],
    inside: dict[str, Schema],
    definitions: Ros2Definitions,
) -> Topic:
    type_name = str(row["type"])
    schema = inside.get(type_name)
    if schema is None:
        schema = definitions.schema(type_name, partial(_sample, database, int(row["id"])))
    latched = is_latched(row.get("offered_qos_profiles", ""))
    return Topic(str(row["name"]), str(row["serialization_format"]), schema, latched)


def _sample(database: BagDatabase, topic: int) -> bytes | None:
    query = f"SELECT data FROM messages WHERE topic_id = {topic} LIMIT 1"
    rows = _query(database, query)
    return bytes(rows[0][0]) if rows else None


def _query(database: BagDatabase, query: str) -> list[tuple[Any, ...]]:
    """Return all rows; none where the table is missing or broken."""
    try:
        return list(database.connection.execute(query))
    except sqlite3.Error:
        return []


def find_parts(database: BagDatabase, topic_of: Mapping[int, int]) -> list[RecordingPart]:
    """Split the messages of a file into parts of about 2,000."""
    if database.cut_short:
        return _parts_of_pages(database, topic_of)
    query = (
        f"SELECT id / {_ROWS}, min(timestamp), max(timestamp), count(*) FROM messages GROUP BY 1"
    )
    rows = _query(database, query)
    if not all(isinstance(value, int) for row in rows for value in row):
        rows = []
    if not rows and _leaves(database):
        _note_damage(database, "SQLite finds the database damaged")
        return _parts_of_pages(database, topic_of)
    return [
        RecordingPart(first, last, count, partial(_load_rows, database, topic_of, number, count))
        for number, first, last, count in rows
    ]


def _parts_of_pages(database: BagDatabase, topic_of: Mapping[int, int]) -> list[RecordingPart]:
    leaves = _leaves(database)
    parts = []
    for start in range(0, len(leaves), _PAGES):
        group = leaves[start : start + _PAGES]
        first, last = min(p.start_ns for p in group), max(p.end_ns for p in group)
        count = sum(p.messages for p in group)
        parts.append(
            RecordingPart(first, last, count, partial(_load_leaves, database, topic_of, group))
        )
    return parts


def _leaves(database: BagDatabase) -> list[LeafPage]:
    """Find the pages with messages, once, and report the rows that none of them holds."""
    if database.leaves is None:
        leaves = find_leaves(open_pages(database.file))
        database.leaves = sorted(leaves, key=attrgetter("first_row"))
        for first, last in missing_rows(database.leaves):
            _note_damage(database, f"{last - first + 1} messages from row {first} on are missing")
    return database.leaves


def _load_rows(
    database: BagDatabase, topic_of: Mapping[int, int], number: int, count: int
) -> list[RecordedMessage]:
    """Read a range of rows with SQLite, or from the pages where it cannot."""
    first, last = number * _ROWS, (number + 1) * _ROWS - 1
    try:
        rows = list(database.connection.execute(_SELECT, (first, last)))
    except sqlite3.Error as error:
        _note_damage(database, f"the database is damaged ({error})")
        leaves = [p for p in _leaves(database) if p.first_row <= last and p.last_row >= first]
        rows = [row for row in _rows_of(database, leaves) if first <= row.number <= last]
    if len(rows) < count:
        _note_damage(
            database, f"{count - len(rows)} messages in rows {first} to {last} are missing"
        )
    return _messages(database, topic_of, rows)


def _rows_of(database: BagDatabase, leaves: Sequence[LeafPage]) -> list[MessageRow]:
    pages = open_pages(database.file)
    return sorted(row for leaf in leaves for row in rows_of(pages, leaf.page))


def _load_leaves(
    database: BagDatabase, topic_of: Mapping[int, int], leaves: Sequence[LeafPage]
) -> list[RecordedMessage]:
    return _messages(database, topic_of, _rows_of(database, leaves))


def _messages(
    database: BagDatabase, topic_of: Mapping[int, int], rows: Sequence[tuple[int, int, int, bytes]]
) -> list[RecordedMessage]:
    known = [  # SQLite returns what it finds, also nulls
        row
        for row in rows
        if row[1] in topic_of and isinstance(row[2], int) and isinstance(row[3], bytes)
    ]
    if len(known) < len(rows):
        lost = len(rows) - len(known)
        _note_damage(database, f"{lost} messages from row {rows[0][0]} on make no sense")
    return [
        RecordedMessage(topic_of[topic], timestamp, None, data)
        for _, topic, timestamp, data in known
    ]


def _note_damage(database: BagDatabase, reason: str) -> None:
    database.report.add_damage(RecordingDamage(database.path.name, 0, database.file.size, reason))
