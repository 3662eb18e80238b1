"""The SQLite files of ROS 2 bags (.db3), whole or damaged: a row that can be read is read.

Messages are read in ranges of row numbers, which is the order they were written in. Where the
database is malformed, the ranges around the damage are read one by one.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from amberbox.blackbox.formats.definitions import Definitions
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Report,
    TopicTable,
)
from amberbox.blackbox.formats.ros2_qos import is_latched
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema, Topic

MAGIC = b"SQLite format 3\0"
_ROWS = 2000
_SELECT = "SELECT id, topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ? ORDER BY id"


@dataclass
class Database:
    """An open .db3 file; ``scratch`` is a folder that goes away with it."""

    path: Path
    connection: sqlite3.Connection
    report: Report
    scratch: tempfile.TemporaryDirectory[str] | None = None

    def close(self) -> None:
        """Close the database and remove what was unpacked for it."""
        self.connection.close()
        if self.scratch is not None:
            self.scratch.cleanup()


def open_database(path: Path, report: Report) -> Database:
    """Open a .db3 file without writing to it or beside it."""
    scratch, place = None, path
    if _has_journal(path):
        # SQLite has to replay what was not yet in the file; that must not happen in the original
        scratch = tempfile.TemporaryDirectory(prefix="amberbox-")
        place = _copy_with_journal(path, Path(scratch.name))
        report.add_note(f"{path.name}: a journal of SQLite was replayed in a copy")
    mode = "" if scratch else "?immutable=1"
    uri = place.resolve().as_uri() + mode
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
    connection.text_factory = lambda text: text.decode(errors="replace")
    return Database(path, connection, report, scratch)


def _has_journal(path: Path) -> bool:
    return any(p.exists() and p.stat().st_size for p in _journals(path))


def _journals(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ("-wal", "-journal")]


def _copy_with_journal(path: Path, folder: Path) -> Path:
    for file in (path, *_journals(path)):
        if file.exists():
            shutil.copyfile(file, folder / file.name)
    return folder / path.name


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


def find_parts(database: Database, topic_of: dict[int, int]) -> list[Part]:
    """Cut the messages of a file into parts of about 2,000."""
    query = (
        f"SELECT id / {_ROWS}, min(timestamp), max(timestamp), count(*) FROM messages GROUP BY 1"
    )
    try:
        rows = list(database.connection.execute(query))
    except sqlite3.Error as error:
        _note_damage(database, f"the database is damaged ({error})")
        return list(_find_parts_one_by_one(database, topic_of))
    return [
        Part(first, last, count, partial(load_rows, database, topic_of, number))
        for number, first, last, count in rows
    ]


def _find_parts_one_by_one(database: Database, topic_of: dict[int, int]) -> Iterator[Part]:
    for number in range(_last_row(database) // _ROWS + 1):
        load = partial(load_rows, database, topic_of, number)
        times = [message.log_time_ns for message in load()]
        if times:
            yield Part(min(times), max(times), len(times), load)


def _last_row(database: Database) -> int:
    rows = _query(database, "SELECT max(id) FROM messages")
    if rows:
        return int(rows[0][0] or 0)
    smallest_row = 32  # bytes: cell and record heads, numbers, an empty CDR message
    return database.path.stat().st_size // smallest_row


def load_rows(database: Database, topic_of: dict[int, int], number: int) -> list[RecordedMessage]:
    """Read the messages of one part."""
    first, last = number * _ROWS, (number + 1) * _ROWS - 1
    try:
        rows = list(database.connection.execute(_SELECT, (first, last)))
    except sqlite3.Error:
        rows = _read_around_damage(database, first, last)
    unknown = {row[1] for row in rows} - topic_of.keys()
    if unknown:
        lost = sum(row[1] in unknown for row in rows)
        _note_damage(database, f"{lost} messages in rows {first} to {last} have no topic")
    return [
        RecordedMessage(topic_of[topic], timestamp, None, bytes(data))
        for _, topic, timestamp, data in rows
        if topic not in unknown
    ]


def _read_around_damage(database: Database, first: int, last: int) -> list[Any]:
    """Read from both ends towards the damage; in between, halve the range until it is small."""
    head = _read_until_error(database, first, last, "ASC")
    if head.complete:
        return head.rows
    after_head = head.rows[-1][0] + 1 if head.rows else first
    tail = _read_until_error(database, after_head, last, "DESC")
    before_tail = tail.rows[-1][0] - 1 if tail.rows else last
    middle = _read_middle(database, after_head, before_tail)
    return head.rows + middle + tail.rows[::-1]


def _read_middle(database: Database, first: int, last: int) -> list[Any]:
    if last - first < 8:
        _note_damage(database, f"messages in rows {first} to {last} cannot be read")
        return []
    half = (first + last) // 2
    before = _read_around_damage(database, first, half)
    return before + _read_around_damage(database, half + 1, last)


@dataclass
class _Rows:
    rows: list[Any]
    complete: bool


def _read_until_error(database: Database, first: int, last: int, order: str) -> _Rows:
    found = _Rows([], True)
    try:
        for row in database.connection.execute(f"{_SELECT} {order}", (first, last)):
            found.rows.append(row)
    except sqlite3.Error:
        found.complete = False
    return found


def _note_damage(database: Database, reason: str) -> None:
    size = database.path.stat().st_size
    database.report.add_damage(Damage(database.path.name, 0, size, reason))
