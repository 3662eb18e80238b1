"""The version of a database: new tables are made, changed tables are migrated by number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sqlalchemy import Column, Connection, Integer, MetaData, Table, Text, func, inspect, select

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.database.metadata import METADATA, Time

SCHEMA_VERSION = Table(
    "schema_version",
    METADATA,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("what", Text, nullable=False),
    Column("applied_ns", Time, nullable=False),
)
"""What was done to the database, by number; the largest is its version."""

FIRST = 1


@dataclass(frozen=True, slots=True)
class Migration:
    """One change to tables that exist; its statements never change once released.

    Numbers go on from 2: the tables as they were first are version 1. A table that is new needs no
    migration.
    """

    number: int
    what: str
    apply: Callable[[Connection], None]


def prepare(
    connection: Connection, metadata: MetaData, migrations: Sequence[Migration], now_ns: int
) -> None:
    """Bring a database up to date, inside the transaction of ``connection``.

    Raises UsageError when it is of a newer version, AmberboxError when its tables are others.
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
    """Return the version of a database; None if there is nothing in it yet."""
    if not inspect(connection).has_table(SCHEMA_VERSION.name):
        return None
    return connection.execute(select(func.max(SCHEMA_VERSION.c.number))).scalar()


def check_version(connection: Connection, migrations: Sequence[Migration]) -> None:
    """Refuse a database of another version, where it cannot be brought up to date."""
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
    """Refuse tables that lack a column: they were made by a build between two versions."""
    held = inspect(connection).get_multi_columns()
    for table in metadata.sorted_tables:
        names = {column["name"] for column in held[(None, table.name)]}
        for column in table.columns:
            if column.name not in names:
                raise AmberboxError(
                    f"the table {table.name} of the database has no column {column.name}",
                    "it was made by a version that was never released: restore a copy",
                )
