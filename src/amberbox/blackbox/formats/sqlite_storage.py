"""The SQLite files of ROS 2 bags (.db3), whole or damaged: a row that can be read is read.

Messages are read in ranges of row numbers, which is the order they were written in. Where SQLite
calls the database malformed, the rows are taken from its pages.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from amberbox.blackbox.formats.bytesource import FileBytes
from amberbox.blackbox.formats.definitions import Definitions
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Report,
    TopicTable,
)
from amberbox.blackbox.formats.ros2_qos import is_latched
from amberbox.blackbox.formats.sqlite_pages import (
    Leaf,
    Row,
    find_leaves,
    missing_rows,
    open_pages,
    rows_of,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

MAGIC = b"SQLite format 3\0"
_ROWS = 2000
_PAGES = 128
_BEGINNING = 1 << 22
_SELECT = "SELECT id, topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ? ORDER BY id"


@dataclass
class Database:
    """An open .db3 file; ``scratch`` is a folder that goes away with it."""

    path: Path
    connection: sqlite3.Connection
    file: FileBytes
    report: Report
    cut_short: bool = False
    scratch: tempfile.TemporaryDirectory[str] | None = None
    leaves: list[Leaf] | None = None

    def close(self) -> None:
        """Close the database and remove what was unpacked for it."""
        self.connection.close()
        self.file.close()
        if self.scratch is not None:
            self.scratch.cleanup()


def open_database(path: Path, report: Report) -> Database:
    """Open a .db3 file without writing to it or beside it."""
    scratch, place = None, path
    missing = _missing_bytes(path)
    if missing or _has_journal(path):
        scratch = tempfile.TemporaryDirectory(prefix="amberbox-")
        place = _stand_in(path, Path(scratch.name), missing)
        _note_repair(path, report, missing)
    uri = place.resolve().as_uri() + ("" if scratch else "?immutable=1")
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
    connection.text_factory = lambda text: text.decode(errors="replace")
    return Database(path, connection, FileBytes(path), report, bool(missing), scratch)


def _missing_bytes(path: Path) -> int:
    """Return how many bytes the file is shorter than its header says."""
    with path.open("rb") as file:
        header = file.read(100)
    page_size = int.from_bytes(header[16:18], "big")
    pages = int.from_bytes(header[28:32], "big")
    return max(0, (65536 if page_size == 1 else page_size) * pages - path.stat().st_size)


def _stand_in(path: Path, folder: Path, missing: int) -> Path:
    """Make a copy for SQLite to work on.

    SQLite replays a journal when it opens a file; that must not happen in the original. A file
    that is cut short it refuses: then a sparse one of full length with the same beginning, where
    the topics are, stands in; the messages come from the original's pages.
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


def _note_repair(path: Path, report: Report, missing: int) -> None:
    if missing:
        report.add_damage(Damage(path.name, path.stat().st_size, missing, "the file is cut short"))
    else:
        report.add_note(f"{path.name}: a journal of SQLite was replayed in a copy")


def _has_journal(path: Path) -> bool:
    return any(p.exists() and p.stat().st_size for p in _journals(path))


def _journals(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ("-wal", "-journal")]


def distribution_of(database: Database) -> str:
    """Return the ROS distribution that wrote the file, as far as it says so."""
    rows = _query(database, "SELECT ros_distro FROM schema")
    return str(rows[0][0]).lower() if rows else ""


def add_topics(database: Database, table: TopicTable, definitions: Definitions) -> dict[int, int]:
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
    inside = _definitions_inside(database)
    return {int(row["id"]): table.add(_topic(database, row, inside, definitions)) for row in topics}


def _topic(
    database: Database, row: dict[str, Any], inside: dict[str, Schema], definitions: Definitions
) -> Topic:
    type_name = str(row["type"])
    schema = inside.get(type_name)
    if schema is None:
        schema = definitions.schema(type_name, partial(_sample, database, int(row["id"])))
    latched = is_latched(row.get("offered_qos_profiles", ""))
    return Topic(str(row["name"]), str(row["serialization_format"]), schema, latched)


def _definitions_inside(database: Database) -> dict[str, Schema]:
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    return {
        str(name): Schema(str(name), str(encoding), str(text).encode())
        for name, encoding, text in _query(database, query)
        if text
    }


def _sample(database: Database, topic: int) -> bytes | None:
    query = f"SELECT data FROM messages WHERE topic_id = {topic} LIMIT 1"
    rows = _query(database, query)
    return bytes(rows[0][0]) if rows else None


def _query(database: Database, query: str) -> list[tuple[Any, ...]]:
    """Return all rows; none where the table is missing or broken."""
    try:
        return list(database.connection.execute(query))
    except sqlite3.Error:
        return []


def find_parts(database: Database, topic_of: Mapping[int, int]) -> list[Part]:
    """Cut the messages of a file into parts of about 2,000."""
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
        Part(first, last, count, partial(_load_rows, database, topic_of, number, count))
        for number, first, last, count in rows
    ]


def _parts_of_pages(database: Database, topic_of: Mapping[int, int]) -> list[Part]:
    leaves = _leaves(database)
    parts = []
    for start in range(0, len(leaves), _PAGES):
        group = leaves[start : start + _PAGES]
        first, last = min(p.start_ns for p in group), max(p.end_ns for p in group)
        count = sum(p.messages for p in group)
        parts.append(Part(first, last, count, partial(_load_leaves, database, topic_of, group)))
    return parts


def _leaves(database: Database) -> list[Leaf]:
    """Find the pages with messages, once, and report the rows that none of them holds."""
    if database.leaves is None:
        database.leaves = sorted(find_leaves(open_pages(database.file)), key=_first_row)
        for first, last in missing_rows(database.leaves):
            _note_damage(database, f"{last - first + 1} messages from row {first} on are missing")
    return database.leaves


def _first_row(leaf: Leaf) -> int:
    return leaf.first_row


def _load_rows(
    database: Database, topic_of: Mapping[int, int], number: int, count: int
) -> list[RecordedMessage]:
    """Read a range of rows with SQLite, or from the pages where it cannot."""
    first, last = number * _ROWS, (number + 1) * _ROWS - 1
    try:
        rows = list(database.connection.execute(_SELECT, (first, last)))
    except sqlite3.Error as error:
        _note_damage(database, f"the database is damaged ({error})")
        rows = _rows_between(database, first, last)
    if len(rows) < count:
        _note_damage(
            database, f"{count - len(rows)} messages in rows {first} to {last} are missing"
        )
    return _messages(database, topic_of, rows)


def _rows_between(database: Database, first: int, last: int) -> list[Row]:
    leaves = [p for p in _leaves(database) if p.first_row <= last and p.last_row >= first]
    return [row for row in _rows_of(database, leaves) if first <= row.number <= last]


def _rows_of(database: Database, leaves: Sequence[Leaf]) -> list[Row]:
    pages = open_pages(database.file)
    return sorted(row for leaf in leaves for row in rows_of(pages, leaf.page))


def _load_leaves(
    database: Database, topic_of: Mapping[int, int], leaves: Sequence[Leaf]
) -> list[RecordedMessage]:
    return _messages(database, topic_of, _rows_of(database, leaves))


def _messages(
    database: Database, topic_of: Mapping[int, int], rows: Sequence[tuple[int, int, int, bytes]]
) -> list[RecordedMessage]:
    known = [row for row in rows if row[1] in topic_of and _is_sound(row)]
    if len(known) < len(rows):
        lost = len(rows) - len(known)
        _note_damage(database, f"{lost} messages from row {rows[0][0]} on make no sense")
    return [
        RecordedMessage(topic_of[topic], timestamp, None, data)
        for _, topic, timestamp, data in known
    ]


def _is_sound(row: tuple[Any, ...]) -> bool:
    """Tell whether values have the right type; SQLite returns what it finds, also nulls."""
    return isinstance(row[2], int) and isinstance(row[3], bytes)


def _note_damage(database: Database, reason: str) -> None:
    database.report.add_damage(Damage(database.path.name, 0, database.file.size, reason))
