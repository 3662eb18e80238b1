"""An archive opened for reading, for one robot or several: the queries of a robot's record, and
SQL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from amberbox.blackbox.columns.arrays import element_type
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query import sql
from amberbox.blackbox.query.overview import ItemInfo, overview
from amberbox.blackbox.query.record import Record, Time
from amberbox.blackbox.query.rows import By, answer
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.segment_file import seq_name
from amberbox.blackbox.store.table_reader import GatheredRows, RowRequest, gather
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import unique_names
from amberbox.core.types import Column, Gap, ItemSchema
from amberbox.server.archive.catalogue import ArchiveCatalogue, RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout, stored_name, table_of
from amberbox.server.archive.gaps import gaps_of
from amberbox.server.archive.reader import ArchiveReader, Span, envelope
from amberbox.server.database import FILE, ServerDatabase

if TYPE_CHECKING:
    import duckdb

    from amberbox.blackbox.retention.missions import RecordedMission
    from amberbox.blackbox.store.clocks import ClockBook


def run_sql(reader: ArchiveReader, statement: str) -> Table:
    """Run a SELECT over the views of an archive; times are UTC, as known at the commit.

    Each data item and child table is a view: ``timestamp``, its variables, ``received``, ``seq``
    (``parent_seq`` in child tables), ``robot``. Of names that differ in case only (robots choose
    them), the first one is kept and others get 4 hex digits.

    Raises AmberboxError when DuckDB refuses the statement, UsageError without DuckDB.
    """

    names = unique_names(sorted(reader.schemas), lambda name: False)

    def create(connection: duckdb.DuckDBPyConnection) -> list[str]:
        return [
            path for table, view in names.items() for path in _view(connection, reader, table, view)
        ]

    return sql.run_views(create, list(names.values()), statement)


def _view(
    connection: duckdb.DuckDBPyConnection, reader: ArchiveReader, table: str, view: str
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
    """Return the SQL expression that converts a stored column to its original type."""
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


def summed(stores: Iterable[Sequence[ItemInfo]]) -> list[ItemInfo]:
    """Return the items of several stores, each once; those of the box come last."""
    found: dict[str, list[ItemInfo]] = {}
    for infos in stores:
        for info in infos:
            found.setdefault(info.name, []).append(info)
    added = []
    for _, infos in sorted(found.items()):
        largest = max(infos, key=lambda info: info.rows)  # the one whose rate is reported
        added.append(
            replace(
                largest,
                rows=sum(info.rows for info in infos),
                first_ns=min(info.first_ns for info in infos),
                last_ns=max(info.last_ns for info in infos),
                bytes=sum(info.bytes for info in infos),
                estimated=any(info.estimated for info in infos),
            )
        )
    return sorted(added, key=lambda info: info.source == channels.SOURCE)


_ATTEMPTS = 5
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ArchiveRecord(Record):
    """The record of some robots in an archive; ``path`` is the server's data folder.

    With several robots, rows have a column ``robot``.
    """

    path: Path
    catalogue: ArchiveCatalogue = field(repr=False)
    robots: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def items(self) -> list[ItemInfo]:
        """Return the items in the tables, summed over robots and stores."""
        return summed(self._look(lambda r: [overview(r.of(source)) for source in r.sources]))

    def has_item(self, item: str) -> bool:
        """See ``Record``."""
        return self._look(lambda reader: item in reader.schemas)

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item: the union over all versions of its schema."""
        schema = self._look(lambda reader: reader.schema(item))
        return ItemSchema(schema.type, schema.columns, {}, schema.stamp)

    def query(
        self,
        item: str,
        variables: Sequence[str] | None = None,
        from_: Time = None,
        to: Time = None,
        by: By = "received",
        points: int | None = None,
        *,
        missions: Sequence[RecordedMission] | None = None,
    ) -> Table:
        """Return rows as on the robot (see ``Record.query``), from the tables of the archive."""
        if missions is not None:
            raise UsageError("missions of an archive cannot be named yet", "give from and to")
        span = self.span_ns(from_, to)
        return self._look(lambda r: _query(r, item, variables, span, by, points))

    def envelope(
        self,
        item: str,
        variables: Sequence[str],
        from_: Time = None,
        to: Time = None,
        points: int = 1000,
    ) -> Table:
        """Return least, greatest and mean of numbers in about ``points`` steps, for long plots.

        Columns are ``timestamp``, then ``x:min``, ``x:max``, ``x:mean``, ``x:count`` for each
        variable. Reads the coarsest rollup level that the steps allow; empty steps have no row.
        With several robots there is a column ``robot``.
        """
        span = self.span_ns(from_, to)
        return self._look(lambda reader: envelope(reader, item, variables, span, points))

    def last_ns(self) -> int | None:
        """Return the latest receive time (ns) in the tables, or None."""
        return self.catalogue.last_ns(self.robots)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return the missing ranges in ``[from_, to)`` with their reasons, including data that
        never arrived.
        """
        span = self.span_ns(from_, to)
        return self._look(lambda reader: gaps_of(reader, self.catalogue, item, span))

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[RecordedMission]:
        """Raise UsageError: missions of an archive are rows of the item ``amberbox_mission``."""
        raise UsageError(
            "missions of an archive cannot be listed yet", "query the item amberbox_mission"
        )

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """Raise UsageError: an archive has no incident files."""
        raise UsageError(f"{self.path} is not a store", "name a store or a robot folder")

    def clock(self) -> ClockBook:
        """Return the clocks of a robot; raises UsageError for several stores."""
        sources = self._sources()
        if len(sources) != 1:
            raise UsageError("each store has clocks of its own", "name a robot with one store")
        return self._look(lambda reader: reader.clocks(sources[0]).book)

    def sql(self, statement: str) -> Table:
        """Run a SELECT: each item and child table is a view, with a column ``robot``."""
        return self._look(lambda reader: run_sql(reader, statement))

    def _sources(self) -> list[RobotStore]:
        found = self.catalogue.sources(self.robots)
        missing = set(self.robots) - {source.robot for source in found}
        if missing:
            known = sorted({source.robot for source in self.catalogue.sources()})
            hint = f"there are: {', '.join(known)}" if known else "nothing has come yet"
            raise UsageError(f"the archive has nothing of {' and '.join(sorted(missing))}", hint)
        return found

    def _look(self, question: Callable[[ArchiveReader], Answer]) -> Answer:
        """Answer from one snapshot of the tables; retry when files were joined meanwhile."""
        sources = self._sources()
        for _ in range(_ATTEMPTS):
            try:
                return question(ArchiveReader(ArchiveLayout(self.path), self.catalogue, sources))
            except FileNotFoundError:
                continue
        raise AmberboxError(
            f"the tables of {self.path} changed while they were being read", "ask again"
        )


def open_archive(folder: Path, robots: Sequence[str] = ()) -> ArchiveRecord:
    """Open the archive in a server's data folder for reading, for some robots or all."""
    database = ServerDatabase(folder / FILE, read_only=True)
    return ArchiveRecord(folder, robots=tuple(robots), catalogue=ArchiveCatalogue(database))


def _query(
    reader: ArchiveReader,
    item: str,
    names: Sequence[str] | None,
    span: Span,
    by: By,
    points: int | None,
) -> Table:
    many = len({source.robot for source in reader.sources}) > 1
    tables = RobotColumnTables(reader) if many else reader
    if names is not None and many:
        names = ["robot", *names]
    return answer(tables, lambda r: gathered(reader, r, many=many), item, names, span, by, points)


class RobotColumnTables:
    """The tables of several robots, each with a column that names the robot of a row."""

    def __init__(self, reader: ArchiveReader) -> None:
        self._reader = reader

    def schema(self, table: str) -> TableSchema:
        """Return a table's columns, ``robot`` first."""
        return with_robot(self._reader.schema(table))

    @property
    def selection(self) -> dict[str, Sequence[str]]:
        """Return the configured variables, and ``robot``."""
        return {item: ["robot", *names] for item, names in self._reader.selection.items()}


_ROBOT = Column("robot", "robot", "string")


def with_robot(schema: TableSchema) -> TableSchema:
    """Return a schema with the column ``robot`` added, unless it has one."""
    if schema.column("robot") is not None:
        return schema
    return replace(schema, columns=(_ROBOT, *schema.columns))


def gathered(
    reader: ArchiveReader, request: RowRequest, *, many: bool, level: str = ""
) -> GatheredRows:
    """Read the rows of a request from all stores."""
    found = GatheredRows()
    for source in reader.sources:
        catalogue = reader.of(source, request.table, request=request, level=level)
        one = gather(catalogue, request)
        found.pieces += [named_by_robot(p, source.robot) if many else p for p in one.pieces]
        found.gaps += one.gaps
        found.notes += one.notes
    return found


def named_by_robot(piece: FlatTable, robot: str) -> FlatTable:
    if piece.schema.column("robot") is not None:
        return piece
    columns = {"robot": np.full(len(piece), robot, object), **piece.columns}
    return replace(piece, schema=with_robot(piece.schema), columns=columns)
