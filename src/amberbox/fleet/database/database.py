"""The server's database: one SQLite file that survives power cuts, and its transactions."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, Engine, MetaData, QueuePool, create_engine, event
from sqlalchemy.exc import DatabaseError, OperationalError

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.database.metadata import complete
from amberbox.fleet.database.migrations import MIGRATIONS
from amberbox.fleet.database.schema import Migration, check_version, prepare

FILE = "server.db"
FOLDER = "amberbox_folder"
"""The option of a connection that says in which folder its database lies."""
BUSY_S = 10.0
_READERS = 48
_BEGIN = "amberbox_begin"
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_LOOK = "look at the disk: is it full, or read-only? then try again"


class DatabaseBusyError(AmberboxError):
    """The database cannot do this now: somebody else writes, or the disk is full or failing."""


class DatabaseDamagedError(AmberboxError):
    """The file is damaged: nothing that is read from it or written to it can be relied on."""

    def __init__(self, path: Path, what: object) -> None:
        super().__init__(
            f"{path} is damaged: {what}",
            "stop the server, move this file and those beside it (-wal, -shm) away, and put a copy "
            "from a backup in its place (docs/serve.md, 'Restore')",
        )


def refuse_damaged(path: Path) -> None:
    """Read a database once as a whole, if there is one; raises DatabaseDamagedError.

    It takes as long as to read the file from the disk.
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


class Database:
    """The tables of the server, in one file; threads may share it.

    ``begin`` writes: one writer at a time, in all processes together, so keep what is slow (hashing
    a password, the network) outside of it, and never open one inside another. ``reading`` sees the
    database as it was when it began, and holds nobody up. Other processes open the same file, with
    ``read_only`` if they only look; after a fork a process needs a Database of its own.
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
                    prepare(connection, metadata or complete(), migrations, now_ns)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def begin(self) -> Iterator[Connection]:
        """Open a transaction that writes: all of it is kept, or nothing when it raises.

        Raises DatabaseBusyError after 10 s behind another writer, or when the disk is full.
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
        """Open a transaction that only reads; all its statements see the same moment."""
        with self._transaction("DEFERRED") as connection:
            yield connection

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
            # what fails while a connection is made comes as the driver says it
            cause = error.orig if isinstance(error, DatabaseError) else error
            if getattr(cause, "sqlite_errorcode", 0) & 0xFF not in _DAMAGE:
                raise
            self.damage = DatabaseDamagedError(self.path, cause)
            raise self.damage from error

    def forget_deleted(self) -> None:
        """Leave nothing of what was overwritten: in free places of the file, or in its log.

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
    """Make the file before SQLite does: it holds hashes of passwords, nobody else reads it."""
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
    """Set what SQLite keeps per connection: durable commits, foreign keys, patience."""
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
