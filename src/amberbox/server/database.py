"""The server's database: one SQLite file, durable across power cuts; transactions and migrations.

New tables are created, existing ones are migrated by number. ``upsert`` inserts or updates rows on
SQLite and PostgreSQL.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

from sqlalchemy import (
    ColumnElement,
    Connection,
    Dialect,
    Engine,
    MetaData,
    QueuePool,
    Row,
    Select,
    Table,
    create_engine,
    event,
    func,
    inspect,
    select,
    text,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.sql.base import ReadOnlyColumnCollection
from sqlalchemy.sql.dml import Insert

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.schema import METADATA, SCHEMA_VERSION

# The columns of the row that was to be inserted
Excluded = ReadOnlyColumnCollection[str, Any]


def upsert(
    dialect: Dialect,
    table: Table,
    key: Sequence[str],
    change: Sequence[str],
    when: Callable[[Excluded], ColumnElement[bool]] | None = None,
) -> Insert:
    """Return a statement that inserts rows, or updates the columns ``change`` of rows with this
    key.

    Without ``change``, existing rows are not changed. ``when`` gets the columns of the new row and
    returns the condition for an update, for instance that it is newer. Execute the statement with a
    list of rows: ``connection.execute(upsert(connection.dialect, ...), rows)``.
    """
    known = [name for name in (*key, *change) if name not in table.c]
    if known:
        raise ValueError(f"the table {table.name} has no column {known[0]}")
    if dialect.name == "postgresql":
        statement: Any = postgresql.insert(table)
    elif dialect.name == "sqlite":
        statement = sqlite.insert(table)
    else:
        raise ValueError(f"no upsert is known for databases of the kind {dialect.name}")
    if not change:
        return cast("Insert", statement.on_conflict_do_nothing(index_elements=list(key)))
    new = {name: statement.excluded[name] for name in change}
    where = None if when is None else when(statement.excluded)
    return cast(
        "Insert",
        statement.on_conflict_do_update(index_elements=list(key), set_=new, where=where),
    )


def upsert_rows(
    connection: Connection,
    table: Table,
    rows: Sequence[Mapping[str, Any]],
    change: Sequence[str] = (),
    when: Callable[[Excluded], ColumnElement[bool]] | None = None,
) -> int:
    """Insert rows or update those with the same primary key (see ``upsert``); return how many."""
    if not rows:
        return 0
    key = [column.name for column in table.primary_key.columns]
    statement = upsert(connection.dialect, table, key, change, when)
    return connection.execute(statement, list(rows)).rowcount


FIRST = 1


@dataclass(frozen=True, slots=True)
class Migration:
    """One change to existing tables; its statements never change once released.

    Numbers start at 2: version 1 is the first release's tables. New tables need no migration.
    """

    number: int
    what: str
    apply: Callable[[Connection], None]


def prepare(
    connection: Connection, metadata: MetaData, migrations: Sequence[Migration], now_ns: int
) -> None:
    """Create or migrate all tables, inside the transaction of ``connection``.

    Raises UsageError for a database of a newer version, AmberboxError when a table lacks a column.
    """
    if [one.number for one in migrations] != list(range(FIRST + 1, FIRST + 1 + len(migrations))):
        raise ValueError("migrations are numbered from 2 on, without holes")
    newest = migrations[-1].number if migrations else FIRST
    held = version(connection)
    if held is None:
        metadata.create_all(connection)
        _note(connection, newest, "made", now_ns)
        return
    if held > newest:
        raise UsageError(
            f"the database is of version {held}, this Amberbox knows {newest}",
            "install the newer Amberbox again, or restore a copy from before it",
        )
    for migration in migrations[held - FIRST :]:
        migration.apply(connection)
        _note(connection, migration.number, migration.what, now_ns)
    metadata.create_all(connection)
    _compare(connection, metadata)


def version(connection: Connection) -> int | None:
    """Return the schema version of a database; None for an empty one."""
    if not inspect(connection).has_table(SCHEMA_VERSION.name):
        return None
    return connection.execute(select(func.max(SCHEMA_VERSION.c.number))).scalar()


def check_version(connection: Connection, migrations: Sequence[Migration]) -> None:
    """Raise UsageError for a database of another version, where it cannot be migrated."""
    newest = migrations[-1].number if migrations else FIRST
    held = version(connection)
    if held != newest:
        raise UsageError(
            f"the database is of version {held}, this Amberbox reads {newest}",
            "start the server once: it brings its database up to date",
        )


def _note(connection: Connection, number: int, what: str, now_ns: int) -> None:
    row = {"number": number, "what": what, "applied_ns": now_ns}
    connection.execute(SCHEMA_VERSION.insert(), [row])


def _compare(connection: Connection, metadata: MetaData) -> None:
    """Raise AmberboxError for tables that lack a column, as unreleased builds made them."""
    held = inspect(connection).get_multi_columns()
    for table in metadata.sorted_tables:
        names = {column["name"] for column in held[(None, table.name)]}
        for column in table.columns:
            if column.name not in names:
                raise AmberboxError(
                    f"the table {table.name} of the database has no column {column.name}",
                    "it was made by a version that was never released: restore a copy",
                )


def _index_rows(connection: Connection) -> None:
    """Create the index of link rows by robot, channel and time."""
    connection.execute(
        text("CREATE INDEX ix_link_row_robot_channel_log_ns ON link_row (robot, channel, log_ns)")
    )


def _keep_diagnoses(connection: Connection) -> None:
    """Add columns for the last diagnosis to alarms; fix intervals that end before they begin."""
    for table, column in (
        ("alarm", "revised BIGINT NOT NULL DEFAULT 0"),
        ("alarm", "effect VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm", "worst VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm", "words TEXT NOT NULL DEFAULT ''"),
        ("alarm_roots", "effect VARCHAR(16) NOT NULL DEFAULT ''"),
        ("alarm_roots", "words TEXT NOT NULL DEFAULT ''"),
    ):
        connection.execute(text(f"ALTER TABLE {table} ADD COLUMN {column}"))
    mend = "UPDATE alarm_consequence SET to_ns = from_ns WHERE to_ns < from_ns"
    connection.execute(text(mend))


def _share_notes(connection: Connection) -> None:
    """Add columns to notes that robots have as well; give older notes an id."""
    for column in (
        "uid VARCHAR(64) NOT NULL DEFAULT ''",
        "to_ns BIGINT",
        "about VARCHAR(200) NOT NULL DEFAULT ''",
        "revision BIGINT NOT NULL DEFAULT 1",
        "withdrawn BOOLEAN NOT NULL DEFAULT 0",
        "written_ns BIGINT NOT NULL DEFAULT 0",
    ):
        connection.execute(text(f"ALTER TABLE mission_note ADD COLUMN {column}"))
    connection.execute(text("UPDATE mission_note SET uid = 'server-' || number"))
    connection.execute(text("CREATE INDEX ix_mission_note_robot_uid ON mission_note (robot, uid)"))


# Every migration since version 1, in order
MIGRATIONS: Sequence[Migration] = (
    Migration(2, "an index of link_row by robot, channel and time", _index_rows),
    Migration(3, "alarms keep what their diagnosis said last", _keep_diagnoses),
    Migration(4, "notes are shared with robots", _share_notes),
)


FILE = "server.db"
# Connection option: the folder of the database
FOLDER = "amberbox_folder"
BUSY_S = 10.0
_READERS = 48
_BEGIN = "amberbox_begin"
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_LOOK = "look at the disk: is it full, or read-only? then try again"


class DatabaseBusyError(AmberboxError):
    """The database cannot be used now: another writer holds it, or the disk is full or failing."""


class DatabaseDamagedError(AmberboxError):
    """The database file is damaged: neither its contents nor new writes can be trusted."""

    def __init__(self, path: Path, what: object) -> None:
        super().__init__(
            f"{path} is damaged: {what}",
            "stop the server, move this file and those beside it (-wal, -shm) away, and put a copy "
            "from a backup in its place (docs/server/serve.md, 'Restore')",
        )


def refuse_damaged(path: Path) -> None:
    """Check the integrity of a whole database file, if it exists; raises DatabaseDamagedError.

    Takes as long as reading the file from the disk.
    """
    if not path.is_file() or not path.stat().st_size:
        return
    try:
        connection = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=rw", uri=True)
        try:
            connection.execute(f"PRAGMA busy_timeout={BUSY_S * 1000:.0f}")
            found = [str(row[0]) for row in connection.execute("PRAGMA quick_check(3)")]
        finally:
            connection.close()
    except sqlite3.OperationalError as error:
        raise DatabaseBusyError(f"{path}: {error}", _LOOK) from error
    except sqlite3.DatabaseError as error:
        raise DatabaseDamagedError(path, error) from error
    if found != ["ok"]:
        raise DatabaseDamagedError(path, "; ".join(" ".join(found).splitlines()[:3]))


class ServerDatabase:
    """The tables of the server, in one SQLite file; threads may share it.

    ``begin`` writes: one writer at a time across all processes, so do slow work (hashing a
    password, the network) outside of it, and never nest it. ``reading`` sees the database as of its
    start and blocks no writer. Other processes open the same file, with ``read_only`` if they do
    not write; after a fork a process needs a ``ServerDatabase`` of its own.
    """

    def __init__(
        self,
        path: Path,
        clock: Clock | None = None,
        *,
        read_only: bool = False,
        metadata: MetaData | None = None,
        migrations: Sequence[Migration] = MIGRATIONS,
    ) -> None:
        self.path = path
        self.damage: DatabaseDamagedError | None = None
        """Set once a transaction has met damage in the file."""
        self._writing = threading.Lock()
        if not read_only:
            _make_private(path)
        self.engine = _engine(path, read_only)
        try:
            if read_only:
                with self.reading() as connection:
                    check_version(connection, migrations)
            else:
                now_ns = (clock or SystemClock()).wall_ns()
                with self.begin() as connection:
                    prepare(connection, metadata or METADATA, migrations, now_ns)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def begin(self) -> Iterator[Connection]:
        """Open a writing transaction: committed as a whole, or rolled back when the block raises.

        Raises DatabaseBusyError after 10 s of waiting for another writer, or when the disk is full.
        """
        if not self._writing.acquire(timeout=BUSY_S):
            raise DatabaseBusyError(f"{self.path} is being written for {BUSY_S:.0f} s", "try again")
        try:
            with self._transaction("IMMEDIATE") as connection:
                yield connection
        finally:
            self._writing.release()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Open a read transaction; all its statements see the same state."""
        with self._transaction("DEFERRED") as connection:
            yield connection

    def rows(self, statement: Select[Any]) -> Sequence[Row[Any]]:
        """Return all rows of one read-only statement."""
        with self.reading() as connection:
            return connection.execute(statement).all()

    def scalar(self, statement: Select[Any]) -> Any:
        """Return the first value of one read-only statement; None without a row."""
        with self.reading() as connection:
            return connection.scalar(statement)

    @contextmanager
    def _transaction(self, kind: str) -> Iterator[Connection]:
        try:
            with (
                self.engine.connect().execution_options(**{_BEGIN: kind}) as connection,
                connection.begin(),
            ):
                yield connection
        except OperationalError as error:
            raise DatabaseBusyError(f"{self.path}: {error.orig}", _LOOK) from error
        except (DatabaseError, sqlite3.DatabaseError) as error:
            # errors while connecting come as the driver raises them
            cause = error.orig if isinstance(error, DatabaseError) else error
            if getattr(cause, "sqlite_errorcode", 0) & 0xFF not in _DAMAGE:
                raise
            self.damage = DatabaseDamagedError(self.path, cause)
            raise self.damage from error

    def forget_deleted(self) -> None:
        """Erase deleted and overwritten data from free pages of the file and from its log.

        Raises DatabaseBusyError, for instance where the disk has no room for a second copy.
        """
        connection = sqlite3.connect(self.path, isolation_level=None)
        try:
            connection.execute(f"PRAGMA busy_timeout={BUSY_S * 1000:.0f}")
            connection.execute("VACUUM")
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        except sqlite3.OperationalError as error:
            raise DatabaseBusyError(f"{self.path}: {error}", _LOOK) from error
        finally:
            connection.close()

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def _make_private(path: Path) -> None:
    """Create the file with mode 0600 before SQLite does: it holds password hashes."""
    try:
        os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    except OSError as error:
        raise AmberboxError(
            f"cannot write {path}: {error.strerror}", "name a folder that the server may write"
        ) from error


def _engine(path: Path, read_only: bool) -> Engine:
    address = f"file:{quote(str(path.absolute()))}?mode={'ro' if read_only else 'rw'}"
    connect = partial(sqlite3.connect, address, uri=True, check_same_thread=False)
    engine = create_engine(
        "sqlite://", creator=connect, poolclass=QueuePool, pool_size=_READERS,
        execution_options={FOLDER: path.absolute().parent},
    )  # fmt: skip
    event.listen(engine, "connect", _configure_reader if read_only else _configure)
    event.listen(engine, "begin", _begin)
    return engine


def _configure(connection: Any, _record: object) -> None:
    """Set the per-connection pragmas of SQLite: durable commits, foreign keys, busy timeout."""
    connection.isolation_level = None  # the driver's own BEGIN comes too late for DDL and reads
    for pragma in (
        f"busy_timeout={BUSY_S * 1000:.0f}",
        "journal_mode=WAL",
        "synchronous=FULL",
        "foreign_keys=ON",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def _configure_reader(connection: Any, _record: object) -> None:
    connection.isolation_level = None
    connection.execute(f"PRAGMA busy_timeout={BUSY_S * 1000:.0f}").close()
    connection.execute("PRAGMA query_only=ON").close()


def _begin(connection: Connection) -> None:
    kind = connection.get_execution_options().get(_BEGIN, "DEFERRED")
    connection.exec_driver_sql(f"BEGIN {kind}")
