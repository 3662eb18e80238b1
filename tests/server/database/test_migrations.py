"""Every migration: an older database gets the schema of a new one, and queries use the indexes."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, Select, inspect

from amberbox.core.notes import RecordedNote
from amberbox.server import annotations as server_annotations
from amberbox.server.database import MIGRATIONS, ServerDatabase
from amberbox.server.derived import from_link
from amberbox.server.schema import METADATA, ROW
from amberbox.server.web.recordings import held
from amberbox.testing.clock import ManualClock

NEW = {
    2: "DROP INDEX ix_link_row_robot_channel_log_ns;",
    3: "".join(
        f"ALTER TABLE {table} DROP COLUMN {column};"
        for table, columns in (
            ("alarm", "revised effect worst words"),
            ("alarm_roots", "effect words"),
        )
        for column in columns.split()
    ),
    4: "DROP INDEX ix_mission_note_robot_uid;"
    + "".join(
        f"ALTER TABLE mission_note DROP COLUMN {column};"
        for column in ("uid", "to_ns", "about", "revision", "withdrawn", "written_ns")
    ),
}
"""What undoes a migration, so that a database is as old as before it."""


def made(path: Path) -> ServerDatabase:
    return ServerDatabase(path, ManualClock())


def aged(path: Path) -> None:
    """Make a database of the first version of a new one."""
    made(path).close()
    with sqlite3.connect(path) as connection:
        for number in sorted(NEW, reverse=True):
            connection.executescript(NEW[number])
        connection.execute("DELETE FROM schema_version")
        connection.execute("INSERT INTO schema_version VALUES (1, 'made', 0)")
    connection.close()


def indexes(database: ServerDatabase) -> dict[str, set[str | None]]:
    with database.reading() as connection:
        found = inspect(connection)
        return {
            table.name: {one["name"] for one in found.get_indexes(table.name)}
            for table in METADATA.sorted_tables
        }


def columns(database: ServerDatabase) -> dict[str, set[tuple[str, str, bool]]]:
    """Return what each table has: names, kinds, whether they may be empty."""
    with database.reading() as connection:
        found = inspect(connection)
        return {
            table.name: {(one["name"], str(one["type"]), bool(one["nullable"]))
                         for one in found.get_columns(table.name)}
            for table in METADATA.sorted_tables
        }  # fmt: skip


def test_an_end_before_its_beginning_is_mended(tmp_path: Path) -> None:
    aged(tmp_path / "old.db")
    with sqlite3.connect(tmp_path / "old.db") as connection:
        connection.execute("INSERT INTO alarm_consequence VALUES (1, 'loc', 'error', '', 50, 20)")
    old = made(tmp_path / "old.db")
    with old.reading() as found:
        assert found.exec_driver_sql("SELECT to_ns FROM alarm_consequence").scalar() == 50
    old.close()


def test_older_notes_get_ids(tmp_path: Path) -> None:
    aged(tmp_path / "old.db")
    with sqlite3.connect(tmp_path / "old.db") as connection:
        connection.execute("INSERT INTO mission_note VALUES (7, 'r', '', 50, 'user:bo', 'hi')")
    old = made(tmp_path / "old.db")
    with old.begin() as found:
        stored = server_annotations.find_note(found, "r", "server-7")
        assert stored is not None
        assert stored.note == RecordedNote("server-7", 50, "user:bo", "hi")
        listed = server_annotations.moment_annotations(found, "r", (None, None), None, 9)
        assert listed == [stored]
    old.close()


def test_an_old_database_becomes_as_a_new_one(tmp_path: Path) -> None:
    assert sorted(NEW) == [one.number for one in MIGRATIONS]
    aged(tmp_path / "old.db")
    old, new = made(tmp_path / "old.db"), made(tmp_path / "new.db")
    assert indexes(old) == indexes(new)
    assert columns(old) == columns(new)
    old.close()
    new.close()


class Explained:
    """A connection that stores SQLite's query plans."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.plans: list[str] = []

    def execute(self, question: Select[Any]) -> Any:
        compiled = question.compile(self.connection, compile_kwargs={"literal_binds": True})
        rows = self.connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {compiled}".replace("%", "%%"))
        self.plans += [row[3] for row in rows]
        return self.connection.execute(question)


@pytest.fixture
def explained(tmp_path: Path) -> Any:
    database = made(tmp_path / "server.db")
    with database.reading() as connection:
        yield Explained(connection)
    database.close()


def plans_of(explained: Explained, table: str) -> list[str]:
    return [plan for plan in explained.plans if f" {table} " in f"{plan} "]


def test_how_far_copying_is_is_asked_of_an_index(explained: Any, tmp_path: Path) -> None:
    held(explained, tmp_path, ["ropod_001", "ropod_002"])
    (plan,) = plans_of(explained, ROW.name)
    assert "USING COVERING INDEX ix_link_row_robot_channel_log_ns (robot=? AND channel=?" in plan
    assert not [plan for plan in explained.plans if plan.startswith("SCAN")]


def test_what_came_over_the_link_is_asked_of_an_index(explained: Any) -> None:
    from_link(explained, "ropod_001", "amberbox/status", (1, 2), 10, newest=True)
    (plan,) = plans_of(explained, ROW.name)
    assert "ix_link_row_robot_channel_log_ns (robot=? AND channel=? AND log_ns>?" in plan
