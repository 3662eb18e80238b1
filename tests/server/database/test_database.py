"""The database: durable, private, one writer, several readers, versions, two dialects."""

from __future__ import annotations

import re
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import (
    Column,
    Connection,
    Integer,
    MetaData,
    String,
    Table,
    func,
    insert,
    inspect,
    select,
    text,
)
from sqlalchemy.exc import IntegrityError
from sqlalchemy.schema import CreateIndex, CreateTable

from amberbox import server
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.database import (
    MIGRATIONS,
    DatabaseBusyError,
    DatabaseDamagedError,
    Migration,
    ServerDatabase,
    refuse_damaged,
    upsert,
    version,
)
from amberbox.server.schema import METADATA, SCHEMA_VERSION
from amberbox.testing.clock import ManualClock
from tests.server.database.portable import POSTGRESQL

NOW = MIGRATIONS[-1].number
"""The version of databases that are made now."""


def _things() -> tuple[MetaData, Table]:
    metadata = MetaData()
    SCHEMA_VERSION.to_metadata(metadata)
    things = Table(
        "things",
        metadata,
        Column("name", String(8), primary_key=True),
        Column("number", Integer, nullable=False),
    )
    return metadata, things


def _rows(database: ServerDatabase, table: Table) -> list[tuple[object, ...]]:
    with database.reading() as connection:
        return [tuple(row) for row in connection.execute(select(table).order_by(table.c.name))]


@pytest.fixture
def metadata() -> MetaData:
    return _things()[0]


@pytest.fixture
def things(metadata: MetaData) -> Table:
    return metadata.tables["things"]


@pytest.fixture
def database(tmp_path: Path, metadata: MetaData) -> ServerDatabase:
    return ServerDatabase(tmp_path / "server.db", ManualClock(), metadata=metadata)


def test_commits_are_durable_and_foreign_keys_hold(database: ServerDatabase) -> None:
    with database.reading() as connection:
        asked = ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        found = {name: connection.execute(text(f"PRAGMA {name}")).scalar() for name in asked}
    assert found == {
        "journal_mode": "wal",
        "synchronous": 2,
        "foreign_keys": 1,
        "busy_timeout": 10_000,
    }


def test_nobody_else_reads_the_files(database: ServerDatabase, things: Table) -> None:
    with database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 1}])
    files = sorted(database.path.parent.iterdir())
    assert [file.name for file in files] == ["server.db", "server.db-shm", "server.db-wal"]
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}


def test_a_transaction_that_raises_leaves_nothing(database: ServerDatabase, things: Table) -> None:
    with pytest.raises(RuntimeError), database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 1}])
        raise RuntimeError("the power goes")
    assert _rows(database, things) == []


def test_a_reader_sees_one_moment(database: ServerDatabase, things: Table) -> None:
    count = select(func.count()).select_from(things)
    with database.reading() as reader:
        before = reader.execute(count).scalar()
        with database.begin() as connection:
            connection.execute(insert(things), [{"name": "a", "number": 1}])
        assert (before, reader.execute(count).scalar()) == (0, 0)
    assert len(_rows(database, things)) == 1


def test_a_reader_cannot_write(database: ServerDatabase, things: Table) -> None:
    other = ServerDatabase(database.path, read_only=True)
    with pytest.raises(DatabaseBusyError, match="readonly"), other.reading() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 1}])


def test_another_process_reads_what_is_committed(database: ServerDatabase, things: Table) -> None:
    with database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 7}])
    program = (
        "import sys; from pathlib import Path\n"
        "from sqlalchemy import text\n"
        "from amberbox.server.database import ServerDatabase\n"
        "with ServerDatabase(Path(sys.argv[1]), read_only=True).reading() as connection:\n"
        "    print(connection.execute(text('SELECT number FROM things')).scalar())\n"
    )
    command = [sys.executable, "-c", program, str(database.path)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "7\n"


def test_threads_that_count_together_lose_nothing(database: ServerDatabase, things: Table) -> None:
    with database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 0}])

    def count(own: ServerDatabase) -> None:
        for _ in range(10):
            with own.begin() as connection:
                held = connection.execute(select(things.c.number)).scalar_one()
                connection.execute(things.update().values(number=held + 1))

    second = ServerDatabase(database.path, ManualClock(), metadata=things.metadata)
    threads = [threading.Thread(target=count, args=(one,)) for one in (database, second) * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert _rows(database, things) == [("a", 40)]


def test_a_file_that_is_no_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "server.db"
    path.write_bytes(b"no database, but long enough to be looked at" * 100)
    with pytest.raises(AmberboxError, match=r"server\.db is damaged: file is not a database"):
        ServerDatabase(path, ManualClock())


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(AmberboxError, match=r"cannot write .*server\.db: No such file"):
        ServerDatabase(tmp_path / "nowhere" / "server.db", ManualClock())


def test_names_with_odd_characters(tmp_path: Path, metadata: MetaData) -> None:
    folder = tmp_path / "the server's 50% data? #1"
    folder.mkdir()
    ServerDatabase(folder / "server.db", ManualClock(), metadata=metadata).close()
    assert (folder / "server.db").stat().st_size > 0


def _add_colour(connection: Connection) -> None:
    connection.execute(text("ALTER TABLE things ADD COLUMN colour VARCHAR(8)"))


def _fail_half_way(connection: Connection) -> None:
    _add_colour(connection)
    raise RuntimeError("the power goes")


def _reopened(
    database: ServerDatabase, apply: Callable[[Connection], None], metadata: MetaData
) -> ServerDatabase:
    database.close()
    migrations = [*MIGRATIONS, Migration(NOW + 1, "colours", apply)]
    return ServerDatabase(database.path, ManualClock(), metadata=metadata, migrations=migrations)


def _coloured() -> MetaData:
    metadata, things = _things()
    things.append_column(Column("colour", String(8)))
    return metadata


def test_a_migration_changes_what_is_there(database: ServerDatabase, things: Table) -> None:
    with database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": 1}])
    coloured = _coloured()
    newer = _reopened(database, _add_colour, coloured)
    assert _rows(newer, coloured.tables["things"]) == [("a", 1, None)]
    with newer.reading() as connection:
        assert version(connection) == NOW + 1
    again = _reopened(newer, _fail_half_way, coloured)  # it is not applied a second time
    assert _rows(again, things) == [("a", 1)]


def test_a_migration_is_done_whole_or_not_at_all(
    database: ServerDatabase, metadata: MetaData
) -> None:
    with pytest.raises(RuntimeError):
        _reopened(database, _fail_half_way, metadata)
    same = ServerDatabase(database.path, ManualClock(), metadata=metadata)
    with same.reading() as connection:
        columns = [column["name"] for column in inspect(connection).get_columns("things")]
        assert (version(connection), columns) == (NOW, ["name", "number"])


def test_a_newer_database_is_refused(database: ServerDatabase, metadata: MetaData) -> None:
    newer = _reopened(database, _add_colour, _coloured())
    newer.close()
    with pytest.raises(UsageError, match=f"version {NOW + 1}, this Amberbox knows {NOW}"):
        ServerDatabase(database.path, ManualClock(), metadata=metadata)
    with pytest.raises(UsageError, match=f"version {NOW + 1}, this Amberbox reads {NOW}"):
        ServerDatabase(database.path, read_only=True)


def test_a_new_table_needs_no_migration(database: ServerDatabase) -> None:
    more, _ = _things()
    Table("others", more, Column("name", String(8), primary_key=True))
    database.close()
    again = ServerDatabase(database.path, ManualClock(), metadata=more)
    assert _rows(again, more.tables["others"]) == []


def test_a_column_without_migration_is_named(database: ServerDatabase) -> None:
    database.close()
    with pytest.raises(AmberboxError, match="the table things of the database has no column col"):
        ServerDatabase(database.path, ManualClock(), metadata=_coloured())


def test_holes_in_the_numbers_are_a_mistake(database: ServerDatabase, metadata: MetaData) -> None:
    database.close()
    with pytest.raises(ValueError, match="without holes"):
        ServerDatabase(
            database.path,
            ManualClock(),
            metadata=metadata,
            migrations=[*MIGRATIONS, Migration(NOW + 2, "colours", _add_colour)],
        )


def test_upsert_changes_what_it_is_told(database: ServerDatabase, things: Table) -> None:
    with database.begin() as connection:
        change = upsert(connection.dialect, things, ("name",), ("number",))
        connection.execute(change, [{"name": "a", "number": 1}, {"name": "b", "number": 5}])
        connection.execute(change, [{"name": "a", "number": 2}])
        keep = upsert(connection.dialect, things, ("name",), ())
        connection.execute(keep, [{"name": "a", "number": 9}, {"name": "c", "number": 9}])
        newer = upsert(
            connection.dialect,
            things,
            ("name",),
            ("number",),
            when=lambda new: new.number > things.c.number,
        )
        connection.execute(newer, [{"name": "b", "number": 4}, {"name": "c", "number": 10}])
    assert _rows(database, things) == [("a", 2), ("b", 5), ("c", 10)]


@pytest.mark.parametrize("change", [(), ("number",)])
def test_upsert_compiles_for_postgresql(change: tuple[str, ...], things: Table) -> None:
    statement = upsert(POSTGRESQL, things, ("name",), change)
    wanted = "DO UPDATE SET number = excluded.number" if change else "DO NOTHING"
    assert f"ON CONFLICT (name) {wanted}" in str(statement.compile(dialect=POSTGRESQL))


def test_upsert_refuses_a_column_that_is_not_there(things: Table) -> None:
    with pytest.raises(ValueError, match="has no column nmae"):
        upsert(POSTGRESQL, things, ("nmae",), ())


def test_every_table_compiles_for_postgresql() -> None:
    tables = METADATA.sorted_tables
    assert {"users", "sessions", "robots", "audit"} <= {table.name for table in tables}
    for table in tables:
        assert str(CreateTable(table).compile(dialect=POSTGRESQL))
        for index in table.indexes:
            assert str(CreateIndex(index).compile(dialect=POSTGRESQL))


@pytest.mark.parametrize("pattern", ["accounts/*.py", "audit.py"])
def test_modules_write_no_sql_by_hand(pattern: str) -> None:
    """What is made by SQLAlchemy is compiled for PostgreSQL, too, in every test of them."""
    folder = Path(server.__path__[0])
    sources = {path.name: path.read_text() for path in folder.glob(pattern)}
    assert sources
    by_hand = re.compile(r"exec_driver_sql|\btext\(\"|import.*\btext\b|executescript")
    assert [name for name, source in sources.items() if by_hand.search(source)] == []


def test_processes_that_start_together_make_one_database(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path\n"
        "from amberbox.server.database import ServerDatabase\n"
        "ServerDatabase(Path(sys.argv[1])).close()\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "server.db")]
    running = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    assert [process.communicate(timeout=60)[1] for process in running] == [""] * 3
    with ServerDatabase(tmp_path / "server.db", read_only=True).reading() as connection:
        assert connection.execute(select(SCHEMA_VERSION.c.what)).scalars().all() == ["made"]


def test_all_tables_of_the_server_are_made(tmp_path: Path) -> None:
    database = ServerDatabase(tmp_path / "server.db", ManualClock())
    with database.reading() as connection:
        assert set(inspect(connection).get_table_names()) == set(METADATA.tables)


def test_an_integrity_error_is_the_callers(database: ServerDatabase, things: Table) -> None:
    with pytest.raises(IntegrityError), database.begin() as connection:
        connection.execute(insert(things), [{"name": "a", "number": None}])


def test_damage_is_found_before_anything_is_read_that_lies_there(tmp_path: Path) -> None:
    path = tmp_path / "server.db"
    refuse_damaged(path)  # there is none yet
    database = ServerDatabase(path)
    with database.begin() as connection:
        connection.execute(text("PRAGMA user_version = 1"))
        page = connection.execute(text("SELECT rootpage FROM sqlite_master WHERE name = 'option'"))
        start = (page.scalar_one() - 1) * 4096
    database.close()
    refuse_damaged(path)
    with path.open("r+b") as file:
        file.seek(start)
        file.write(b"\xaa" * 4096)
    ServerDatabase(path).close()  # nothing shows
    with pytest.raises(DatabaseDamagedError, match=r"server\.db is damaged: .*\nhint: stop the"):
        refuse_damaged(path)


def test_damage_that_shows_itself_later_is_remembered(tmp_path: Path) -> None:
    database = ServerDatabase(tmp_path / "server.db")
    with database.reading() as connection:
        page = connection.execute(text("SELECT rootpage FROM sqlite_master WHERE name = 'option'"))
        start = (page.scalar_one() - 1) * 4096
    database.close()
    with (tmp_path / "server.db").open("r+b") as file:
        file.seek(start)
        file.write(b"\xaa" * 4096)
    with pytest.raises(DatabaseDamagedError), database.reading() as connection:
        connection.execute(text("SELECT * FROM option")).all()
    assert database.damage is not None
    database.close()
