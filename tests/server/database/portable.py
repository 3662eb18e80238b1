"""A database for tests that notes every statement, to ask PostgreSQL's compiler about it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import ClauseElement, Dialect, event
from sqlalchemy.dialects import sqlite
from sqlalchemy.dialects.postgresql.base import PGDialect

from amberbox.server.database import FILE, ServerDatabase
from amberbox.testing.clock import ManualClock

POSTGRESQL: Dialect = PGDialect()  # type: ignore[no-untyped-call]  # SQLAlchemy has no types for it


@contextmanager
def portable_database(folder: Path, clock: ManualClock) -> Iterator[ServerDatabase]:
    """Open a database in which a statement fails that PostgreSQL could not be given."""
    database = ServerDatabase(folder / FILE, clock)
    event.listen(database.engine, "before_execute", refuse_what_is_not_portable)
    try:
        yield database
    finally:
        database.close()


def refuse_what_is_not_portable(
    connection: object, statement: Any, multi: object, params: object, options: object
) -> None:
    """Raise CompileError or AssertionError for what only SQLite understands."""
    assert isinstance(statement, ClauseElement), f"not made by SQLAlchemy: {statement!r}"
    if isinstance(statement, sqlite.Insert) and statement._post_values_clause is not None:
        # What ``upsert`` makes for PostgreSQL may name a constraint; here it names columns.
        statement._post_values_clause.constraint_target = None  # type: ignore[attr-defined] # see above
    assert str(statement.compile(dialect=POSTGRESQL))
