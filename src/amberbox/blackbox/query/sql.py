"""SQL over a record: DuckDB with one view per data item, shut off from everything else."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeAlias

from amberbox.blackbox.columns.arrays import NUMPY_TYPES, element_type
from amberbox.blackbox.columns.arrow import arrow_type, from_arrow
from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.blackbox.store.clocks import ClockTable, OffsetPiece
from amberbox.blackbox.store.manifest_entries import Segment, part_clock
from amberbox.blackbox.store.segment_file import seq_name, stored_name
from amberbox.blackbox.store.table_reader import (
    RowRequest,
    from_journals,
    gather,
    merge,
    without_damage,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import below
from amberbox.core.types import Column, ColumnData

if TYPE_CHECKING:
    import duckdb
    import pyarrow as pa

Pieces: TypeAlias = tuple[tuple[int, OffsetPiece], ...]

_JOURNALS = "journals"  # schema of the rows that no segment serves

_PERIOD_S = 0.05
_UNREAD = "amberbox: not read yet"
_FAILS = f"error('{_UNREAD}')"
# Words of statements that may get at columns without naming them
_EVERY = frozenset({"columns", "explain"})

_TYPES = {
    "bool": "BOOLEAN",
    "int8": "TINYINT",
    "int16": "SMALLINT",
    "int32": "INTEGER",
    "int64": "BIGINT",
    "uint8": "UTINYINT",
    "uint16": "USMALLINT",
    "uint32": "UINTEGER",
    "uint64": "UBIGINT",
    "float32": "FLOAT",
    "float64": "DOUBLE",
    "string": "VARCHAR",
    "binary": "BLOB",
    "duration": "BIGINT",
}


def run_sql(catalogue: StoreCatalogue, statement: str) -> Table:
    """Run a SELECT over the views of a record; times are UTC.

    Each data item and child table is a view: ``timestamp``, its variables, ``received``, ``seq``
    (``parent_seq`` in child tables). DuckDB sees the store's segments and nothing else: no other
    file, no network, no extension, and it changes nothing.

    Rows of journals are read only of the tables, and only in the columns, that the statement names.
    Tables used in other ways (``*``, ``query_table``) are read when the statement fails without
    them.

    Raises UsageError without DuckDB, or when the statement is wrong or not a single SELECT,
    DESCRIBE, SHOW or EXPLAIN; AmberboxError when DuckDB cannot carry it out.
    """
    named, names = _Named(statement), sorted(catalogue.schemas)
    for reading in (named, replace(named, all_columns=True), replace(named, all_tables=True)):
        notes: list[str] = []
        try:
            create = partial(_create_views, catalogue, reading, notes)
            return replace(run_views(create, names, statement), notes=tuple(notes))
        except AmberboxError as error:
            if reading.all_tables or _UNREAD not in error.what:
                raise
    raise AssertionError("the last of these reads everything")


@dataclass(frozen=True)
class _Named:
    """The names in a statement, and so the tables and columns to read from journals."""

    statement: str
    all_columns: bool = False
    all_tables: bool = False

    @cached_property
    def _words(self) -> frozenset[str]:
        return frozenset(re.findall(r"\w+", self.statement.casefold()))

    def _names(self, name: str) -> bool:
        known = name.casefold()
        return known in self._words or (
            re.fullmatch(r"\w+", known) is None and known in self.statement.casefold()
        )

    def table(self, name: str) -> bool:
        """Return whether rows of a table are wanted."""
        return self.all_tables or self._names(name)

    def columns(self, schema: TableSchema) -> list[str]:
        """Return the columns of a table that are wanted."""
        star = "*" in re.sub(r"count\s*\(\s*\*\s*\)", "", self.statement, flags=re.IGNORECASE)
        every = self.all_columns or self.all_tables or star or self._words & _EVERY
        return [c.name for c in schema.columns if every or self._names(c.name)]


def _create_views(
    catalogue: StoreCatalogue,
    named: _Named,
    notes: list[str],
    connection: duckdb.DuckDBPyConnection,
) -> list[str]:
    """Create a view for each table; damage of those that are read is added to ``notes``."""
    files: list[str] = []
    for table in sorted(catalogue.schemas):
        if named.table(table):
            sound, damage = without_damage(catalogue, table)  # DuckDB checks no checksums
            notes.extend(damage)
            _create_view(connection, sound, table, named, files)
        else:
            _create_unread_view(connection, catalogue.schema(table))
    return files


def run_views(
    create: Callable[[duckdb.DuckDBPyConnection], Sequence[str]],
    names: Sequence[str],
    statement: str,
) -> Table:
    """Run a SELECT over views that ``create`` makes; ``create`` returns the files they read."""
    duckdb = _duckdb()
    wrong = (duckdb.ProgrammingError, duckdb.DataError, duckdb.NotSupportedError,
             duckdb.PermissionException)  # fmt: skip
    with duckdb.connect(":memory:") as connection:
        connection.execute("SET TimeZone = 'UTC'")
        files = create(connection)
        connection.execute("SET autoinstall_known_extensions = false")
        connection.execute("SET autoload_known_extensions = false")
        connection.execute("SET python_enable_replacements = false")
        connection.execute(f"SET allowed_paths = [{', '.join(map(quoted, files))}]")
        connection.execute("SET enable_external_access = false")
        connection.execute("SET lock_configuration = true")
        try:
            kinds = [parsed.type.name for parsed in connection.extract_statements(statement)]
            if len(kinds) != 1 or kinds[0] not in ("SELECT", "EXPLAIN"):
                raise UsageError(
                    f"SQL: expected one SELECT, not {' and '.join(kinds) or 'nothing'}",
                    "sql only reads; SELECT, DESCRIBE, SHOW TABLES and EXPLAIN work",
                )
            answer = _answer(connection, statement)
            fields, columns = [], {}
            for name, array in zip(_distinct(answer.column_names), answer.columns, strict=True):
                kind, known = _known(array)
                fields.append(Column(name, name, kind))
                columns[name] = from_arrow(known, kind)
            return Table("sql", tuple(fields), columns)
        except wrong as error:
            raise UsageError(f"SQL: {error}", _hint(names)) from error
        except duckdb.Error as error:  # memory, files: the statement is not at fault
            raise AmberboxError(f"SQL: {error}", _hint(names)) from error


def _answer(connection: duckdb.DuckDBPyConnection, statement: str) -> Any:
    """Run a statement on a thread of its own: DuckDB itself does not heed Ctrl-C."""
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(lambda: connection.sql(statement).to_arrow_table())
        try:
            return asked.result()
        except KeyboardInterrupt:
            while not asked.done():  # an interrupt before it begins does nothing
                connection.interrupt()
                wait([asked], _PERIOD_S)
            raise


def _duckdb() -> Any:
    try:
        import duckdb
    except ImportError:
        raise UsageError("sql needs DuckDB", "pip install 'amberbox[query]'") from None
    return duckdb


def _hint(names: Sequence[str]) -> str:
    return "views: " + ", ".join(names)


def _create_unread_view(connection: duckdb.DuckDBPyConnection, schema: TableSchema) -> None:
    """Make a view that has a table's columns, and fails when its rows are read."""
    columns = ", ".join(_unread(column) for column in _fields(schema))
    connection.execute(
        f"CREATE VIEW {quoted_name(schema.item)} AS SELECT {columns} WHERE {_FAILS}::BOOLEAN"
    )


def _unread(column: Column) -> str:
    return f"{_FAILS}::{sql_type(column.type)} AS {quoted_name(column.name)}"


def _fields(schema: TableSchema) -> tuple[Column, ...]:
    """Return the columns of a table's view."""
    seq = seq_name(schema)
    return (
        Column("timestamp", "timestamp", "time"),
        *schema.columns,
        Column("received", "received", "time"),
        Column(seq, seq, "int64"),
    )


def _create_view(
    connection: duckdb.DuckDBPyConnection,
    catalogue: StoreCatalogue,
    table: str,
    named: _Named,
    files: list[str],
) -> None:
    schema = catalogue.schema(table)
    groups = {} if _needs_text(catalogue, schema) else _groups(catalogue, table)
    selects = [
        _select(schema, version, pieces, paths) for (version, pieces), paths in groups.items()
    ]
    files += (path for paths in groups.values() for path in paths)
    names = named.columns(schema)
    rest = _journal_rows(catalogue, schema, names, also_segments=not groups)
    if rest is not None:
        read = set(rest.column_names)
        columns = [quoted_name(c.name) if c.name in read else _unread(c) for c in _fields(schema)]
        selects.append(f"SELECT {', '.join(columns)} FROM {_beside(connection, table, rest)}")
    connection.execute(f"CREATE VIEW {quoted_name(table)} AS {' UNION ALL '.join(selects)}")


def _beside(connection: duckdb.DuckDBPyConnection, table: str, rows: pa.Table) -> str:
    """Make a view of rows in memory that SHOW TABLES does not list, and return its full name."""
    connection.execute(f"CREATE SCHEMA IF NOT EXISTS {_JOURNALS}; USE {_JOURNALS}")
    connection.from_arrow(rows).create_view(table)
    connection.execute("USE main")
    return f"{_JOURNALS}.{quoted_name(table)}"


def _groups(catalogue: StoreCatalogue, table: str) -> dict[tuple[TableSchema, Pieces], list[str]]:
    """Group a table's segments by schema version and clock: each group is one SELECT."""
    groups: dict[tuple[TableSchema, Pieces], list[str]] = {}
    for segment in catalogue.segments(table):
        version = catalogue.manifest.schemas[segment.schema]
        path = str(below(catalogue.store, segment.path).resolve())
        groups.setdefault((version, _pieces(segment)), []).append(path)
    return groups


def _select(schema: TableSchema, version: TableSchema, pieces: Pieces, paths: Sequence[str]) -> str:
    columns = ", ".join(_columns(schema, version, pieces))
    return f"SELECT {columns} FROM read_parquet([{', '.join(map(quoted, paths))}])"


def _needs_text(catalogue: StoreCatalogue, schema: TableSchema) -> bool:
    """Return whether numbers became text: we convert them, so that SQL and query agree."""
    kinds = {column.name: column.type for column in schema.columns}
    return any(
        column.type != kinds[column.name] and "string" in kinds[column.name]
        for version in catalogue.schemas[schema.item]
        for column in version.columns
    )


def _pieces(segment: Segment) -> Pieces:
    """Return the clock offsets, each from a log time on; most files have a single one."""
    found: list[tuple[int, OffsetPiece]] = []
    for part in segment.parts:
        for piece in ClockTable(part_clock(part)).pieces():
            if not found or piece.rate or found[-1][1][1:] != piece[1:]:
                found.append((max(piece.log_ns, part.from_ns), piece))
    if len(found) == 1 and not found[0][1].rate:
        return ((0, OffsetPiece(0, found[0][1].offset_ns, 0.0)),)
    return tuple(found)


def _columns(schema: TableSchema, version: TableSchema, pieces: Pieces) -> list[str]:
    received = f"make_timestamp_ns(log_time + {_offset(pieces)})"
    stamp = '"timestamp"::TIMESTAMP_NS' if schema.stamp else received
    return [
        f'{stamp} AS "timestamp"',
        *(_column(column, version) for column in schema.columns),
        f'{received} AS "received"',
        quoted_name(seq_name(schema)),
    ]


def _offset(pieces: Pieces) -> str:
    *later, (_, first) = reversed(pieces)
    if not later:
        return _offset_of(first)
    cases = " ".join(f"WHEN log_time >= {at} THEN {_offset_of(piece)}" for at, piece in later)
    return f"CASE {cases} ELSE {_offset_of(first)} END"


def _offset_of(piece: OffsetPiece) -> str:
    """Compute as ``ClockTable`` does, to the nanosecond."""
    if not piece.rate:
        return str(piece.offset_ns)
    since = f"greatest(log_time - {piece.log_ns}, 0)::DOUBLE"
    return f"({piece.offset_ns} + round_even({since} * {piece.rate!r}::DOUBLE, 0)::BIGINT)"


def _column(column: Column, version: TableSchema) -> str:
    known = version.column(column.name)
    if known is None:
        return f"NULL::{sql_type(column.type)} AS {quoted_name(column.name)}"
    stored = quoted_name(stored_name(column.name))
    if known.type != column.type:
        stored = f"{stored}::{sql_type(column.type)}"
    return f"{stored} AS {quoted_name(column.name)}"


def sql_type(column_type: str) -> str:
    """Return the type in DuckDB that holds a column."""
    inner = element_type(column_type)
    if inner is not None:
        return f"{sql_type(inner)}[]"
    return _TYPES.get(column_type, "TIMESTAMP_NS")


def quoted_name(name: str) -> str:
    """Return a name quoted for SQL."""
    return '"' + name.replace('"', '""') + '"'


def quoted(text: str) -> str:
    """Return a text quoted for SQL."""
    return "'" + text.replace("'", "''") + "'"


def _journal_rows(
    catalogue: StoreCatalogue, schema: TableSchema, names: Sequence[str], *, also_segments: bool
) -> pa.Table | None:
    """Return the rows that no segment serves, as an Arrow table with some of the columns."""
    import pyarrow as pa

    request = RowRequest(schema.item, names)
    found = gather(catalogue, request) if also_segments else from_journals(catalogue, request)
    if not found.pieces and not also_segments:
        return None
    rows = merge(found.pieces, schema, names, "received")
    keys: dict[str, ColumnData] = {"received": rows.received_ns, seq_name(schema): rows.seq}
    columns = {"timestamp": rows.timestamp_ns, **rows.columns, **keys}
    fields = tuple(field for field in _fields(schema) if field.name in columns)
    table = Table(schema.item, fields, columns).to_arrow()
    plain = pa.timestamp("ns")  # times in plain UTC, as the segments' are in the views
    kinds = [plain if pa.types.is_timestamp(f.type) else f.type for f in table.schema]
    return table.cast(pa.schema(list(zip(table.schema.names, kinds, strict=True))))


def _distinct(names: Sequence[str]) -> list[str]:
    """Make names of columns unique: ``a``, ``a_2``."""
    seen: dict[str, int] = {}
    distinct = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        distinct.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return distinct


def _known(array: pa.ChunkedArray) -> tuple[str, pa.ChunkedArray]:
    import pyarrow as pa

    kind = array.type
    if pa.types.is_timestamp(kind):
        return "time", array.cast(pa.timestamp("ns"))
    if pa.types.is_decimal(kind):
        return _decimal(array)
    if pa.types.is_list(kind):
        inner, _ = _known(pa.chunked_array([], kind.value_type))
        if inner == "time":  # in the views times are plain UTC
            return "list<time>", array.cast(arrow_type("list<time>"))
        if array.type == arrow_type(f"list<{inner}>"):
            return f"list<{inner}>", array
    for name in (*NUMPY_TYPES, "string", "binary"):
        if kind == arrow_type(name):
            return name, array
    texts = [None if value is None else str(value) for value in array.to_pylist()]
    return "string", pa.chunked_array([pa.array(texts, pa.string())])


def _decimal(array: pa.ChunkedArray) -> tuple[str, pa.ChunkedArray]:
    """Return DuckDB's 128-bit sums of integers as 64-bit integers where they fit."""
    import pyarrow as pa

    if array.type.scale == 0:
        try:
            return "int64", array.cast(pa.int64())
        except pa.ArrowInvalid:
            return "float64", array.cast(pa.float64())
    return "float64", array.cast(pa.float64())
