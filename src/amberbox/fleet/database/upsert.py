"""Insert rows, or change those that are there already: for SQLite and PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Dialect, Table
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.sql.base import ReadOnlyColumnCollection
from sqlalchemy.sql.dml import Insert

Excluded = ReadOnlyColumnCollection[str, Any]
"""The columns of the row that was to be inserted."""


def upsert(
    dialect: Dialect,
    table: Table,
    key: Sequence[str],
    change: Sequence[str],
    when: Callable[[Excluded], ColumnElement[bool]] | None = None,
) -> Insert:
    """Make a statement that inserts rows; of a row with this key, the columns ``change`` change.

    With no columns to change, the row that is there stays as it is. ``when`` gets the columns of
    the new row and makes the condition for a change, for instance that it is newer. Execute it
    with a list of rows: ``connection.execute(upsert(connection.dialect, ...), rows)``.
    """
    known = [name for name in (*key, *change) if name not in table.c]
    if known:
        raise ValueError(f"the table {table.name} has no column {known[0]}")
    if dialect.name == "postgresql":
        return _postgresql(table, key, change, when)
    if dialect.name == "sqlite":
        return _sqlite(table, key, change, when)
    raise ValueError(f"no upsert is known for databases of the kind {dialect.name}")


def _sqlite(
    table: Table,
    key: Sequence[str],
    change: Sequence[str],
    when: Callable[[Excluded], ColumnElement[bool]] | None,
) -> Insert:
    statement = sqlite.insert(table)
    if not change:
        return statement.on_conflict_do_nothing(index_elements=list(key))
    new = {name: statement.excluded[name] for name in change}
    where = None if when is None else when(statement.excluded)
    return statement.on_conflict_do_update(index_elements=list(key), set_=new, where=where)


def _postgresql(
    table: Table,
    key: Sequence[str],
    change: Sequence[str],
    when: Callable[[Excluded], ColumnElement[bool]] | None,
) -> Insert:
    statement = postgresql.insert(table)
    if not change:
        return statement.on_conflict_do_nothing(index_elements=list(key))
    new = {name: statement.excluded[name] for name in change}
    where = None if when is None else when(statement.excluded)
    return statement.on_conflict_do_update(index_elements=list(key), set_=new, where=where)
