"""SQL over an archive: DuckDB with one view per data item, shut off from everything else."""

from __future__ import annotations

from typing import TYPE_CHECKING

from amberbox.blackbox.query import sql
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments.columns import element_type
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.parquet import seq_name
from amberbox.core.names import unique_names
from amberbox.core.types import Column
from amberbox.fleet.archive.files import table_of
from amberbox.fleet.archive.layout import stored_name
from amberbox.fleet.archive.reading import Reader

if TYPE_CHECKING:
    import duckdb


def run_sql(reader: Reader, statement: str) -> Table:
    """Answer a SELECT over the views of an archive; times are UTC, as known at the commit.

    Each data item and child table is a view: ``timestamp``, its variables, ``received``, ``seq``
    (``parent_seq`` in child tables), ``robot``. Of names that differ in case only (robots choose
    them), the first one keeps its own and others get 4 hex digits.

    Raises AmberboxError when DuckDB refuses the statement, UsageError without DuckDB.
    """

    names = unique_names(sorted(reader.schemas), lambda name: False)

    def create(connection: duckdb.DuckDBPyConnection) -> list[str]:
        return [
            path for table, view in names.items() for path in _view(connection, reader, table, view)
        ]

    return sql.run_views(create, list(names.values()), statement)


def _view(
    connection: duckdb.DuckDBPyConnection, reader: Reader, table: str, view: str
) -> list[str]:
    union, paths, selects = reader.schema(table), list[str](), list[str]()
    for source in reader.sources:
        for version in reader.schemas[table]:
            folder = reader.layout.table(table_of(version))
            files = [
                str((folder / file.path).resolve()) for file in reader.files(source, version, None)
            ]
            if files:
                paths += files
                selects.append(_select(union, version, source.robot, files))
    text = " UNION ALL ".join(selects) or _empty(union)
    connection.execute(f"CREATE VIEW {sql.quoted_name(view)} AS {text}")
    return paths


def _select(union: TableSchema, version: TableSchema, robot: str, files: list[str]) -> str:
    columns = [
        'make_timestamp_ns("timestamp") AS "timestamp"',
        *(_column(column, version) for column in union.columns),
        'make_timestamp_ns("received") AS "received"',
        sql.quoted_name(seq_name(union)),
        *([] if union.column("robot") else [f'{sql.quoted(robot)} AS "robot"']),
    ]
    paths = ", ".join(map(sql.quoted, files))
    options = "hive_partitioning = false"
    return f"SELECT {', '.join(columns)} FROM read_parquet([{paths}], {options})"


def _column(column: Column, version: TableSchema) -> str:
    known, name = version.column(column.name), sql.quoted_name(column.name)
    if known is None:
        return f"NULL::{sql.sql_type(column.type)} AS {name}"
    stored = sql.quoted_name(stored_name(column.name))
    return f"{_value(stored, known.type, column.type)} AS {name}"


def _value(stored: str, known: str, wanted: str) -> str:
    """Undo what the files do to types that Delta does not have."""
    inner, target = element_type(known), element_type(wanted)
    if inner in ("time", "uint64") and target is not None:
        return f"[{_value('x', inner, target)} for x in {stored}]"
    if known == wanted == "time":
        return f"make_timestamp_ns({stored})"
    if known == "uint64":  # stored with the same bits
        stored = f"({stored}::HUGEINT & {2**64 - 1}::HUGEINT)::UBIGINT"
    return f"{stored}::{sql.sql_type(wanted)}"


def _empty(union: TableSchema) -> str:
    names = ["timestamp", *(column.name for column in union.columns), "received", seq_name(union)]
    kinds = [
        "TIMESTAMP_NS",
        *(sql.sql_type(c.type) for c in union.columns),
        "TIMESTAMP_NS",
        "BIGINT",
    ]
    columns = [
        f"NULL::{kind} AS {sql.quoted_name(name)}" for name, kind in zip(names, kinds, strict=True)
    ]
    return f"SELECT {', '.join(columns)} WHERE false"
