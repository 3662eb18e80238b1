"""An archive opened for reading: the same questions as on the robot, for one robot or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.gather import Gathered, Request, gather
from amberbox.blackbox.query.overview import ItemInfo, overview
from amberbox.blackbox.query.record import By, Record, Time, answer
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import identifier
from amberbox.core.types import Column, Gap, ItemSchema
from amberbox.fleet.archive.catalogue import Catalogue, Source
from amberbox.fleet.archive.envelope import envelope
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.gaps import gaps_of
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.archive.views import run_sql
from amberbox.fleet.database.database import FILE, Database

if TYPE_CHECKING:
    from amberbox.blackbox.missions import Mission
    from amberbox.blackbox.query.clockbook import ClockBook

_ATTEMPTS = 5
Answer = TypeVar("Answer")


@dataclass(frozen=True, kw_only=True)
class ArchiveRecord(Record):
    """The record of some robots in an archive; ``path`` is the server's data folder.

    With several robots, rows have a column ``robot``.
    """

    robots: tuple[str, ...] = ()
    catalogue: Catalogue = field(repr=False)

    def items(self) -> list[ItemInfo]:
        """Return what is in the tables: of several robots or stores the sum."""
        found: dict[str, list[ItemInfo]] = {}
        for infos in self._look(lambda r: [overview(r.of(source)) for source in r.sources]):
            for info in infos:
                found.setdefault(info.name, []).append(info)
        summed = [_summed(infos) for _, infos in sorted(found.items())]
        return sorted(summed, key=lambda info: info.source == reserved.SOURCE)

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
        missions: Sequence[Mission] | None = None,
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

        Columns are ``timestamp``, then ``x:min``, ``x:max``, ``x:mean``, ``x:count`` for each.
        Reads the pyramid as far up as the steps allow; of a step that holds nothing there is no
        row. One robot at a time: with several there is a column ``robot``.
        """
        span = self.span_ns(from_, to)
        return self._look(lambda reader: envelope(reader, item, variables, span, points))

    def last_ns(self) -> int | None:
        """Return when the newest record in the tables was received."""
        return self.catalogue.last_ns(self.robots)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return what is missing in ``[from_, to)`` and why, also what never came here."""
        span = self.span_ns(from_, to)
        return self._look(lambda reader: gaps_of(reader, self.catalogue, item, span))

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[Mission]:
        """Refuse: the missions of an archive are rows of the item ``amberbox_mission``."""
        raise UsageError(
            "missions of an archive cannot be listed yet", "query the item amberbox_mission"
        )

    def clock(self) -> ClockBook:
        """Return what is known of the clocks of a robot; raises UsageError for several stores."""
        sources = self._sources()
        if len(sources) != 1:
            raise UsageError("each store has clocks of its own", "name a robot with one store")
        return self._look(lambda reader: reader.clocks(sources[0]).book)

    def sql(self, statement: str) -> Table:
        """Answer a SELECT: each item and child table is a view, with a column ``robot``."""
        return self._look(lambda reader: run_sql(reader, statement))

    def events(self, from_: Time = None, to: Time = None) -> Table:
        """Return what happened to the boxes."""
        name, span = identifier(reserved.EVENT), self.span_ns(from_, to)
        if not self._look(lambda reader: name in reader.schemas):
            stamp = Column("timestamp", "timestamp", "time")
            return Table("events", (stamp,), {"timestamp": np.empty(0, np.int64)})
        return self.query(name, None, *span)

    def _sources(self) -> list[Source]:
        found = self.catalogue.sources(self.robots)
        missing = set(self.robots) - {source.robot for source in found}
        if missing:
            known = sorted({source.robot for source in self.catalogue.sources()})
            hint = f"there are: {', '.join(known)}" if known else "nothing has come yet"
            raise UsageError(f"the archive has nothing of {' and '.join(sorted(missing))}", hint)
        return found

    def _look(self, question: Callable[[Reader], Answer]) -> Answer:
        """Answer from one look at the tables; look again when files were joined meanwhile."""
        sources = self._sources()
        for _ in range(_ATTEMPTS):
            try:
                return question(Reader(Layout(self.path), self.catalogue, sources))
            except FileNotFoundError:
                continue
        raise AmberboxError(
            f"the tables of {self.path} changed while they were being read", "ask again"
        )


def open_archive(folder: Path, robots: Sequence[str] = ()) -> ArchiveRecord:
    """Open the archive in a server's data folder for reading: robots by name, else all."""
    database = Database(folder / FILE, read_only=True)
    return ArchiveRecord(folder, robots=tuple(robots), catalogue=Catalogue(database))


def _query(
    reader: Reader,
    item: str,
    names: Sequence[str] | None,
    span: tuple[int | None, int | None],
    by: By,
    points: int | None,
) -> Table:
    many = len({source.robot for source in reader.sources}) > 1
    tables = WithRobot(reader) if many else reader
    if names is not None and many:
        names = ["robot", *names]
    return answer(tables, lambda r: gathered(reader, r, many=many), item, names, span, by, points)


class WithRobot:
    """The tables of several robots: each has a column that says whose row it is."""

    def __init__(self, reader: Reader) -> None:
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
    """Add the column ``robot`` to a table that has none of its own."""
    if schema.column("robot") is not None:
        return schema
    return replace(schema, columns=(_ROBOT, *schema.columns))


def gathered(reader: Reader, request: Request, *, many: bool, level: str = "") -> Gathered:
    """Read the rows of a request from all stores."""
    found = Gathered()
    for source in reader.sources:
        catalogue = reader.of(source, request.table, request=request, level=level)
        one = gather(catalogue, request)
        found.pieces += [_told(p, source.robot) if many else p for p in one.pieces]
        found.gaps += one.gaps
        found.notes += one.notes
    return found


def _told(piece: Flat, robot: str) -> Flat:
    if piece.schema.column("robot") is not None:
        return piece
    columns = {"robot": np.full(len(piece), robot, object), **piece.columns}
    return replace(piece, schema=with_robot(piece.schema), columns=columns)


def _summed(infos: Sequence[ItemInfo]) -> ItemInfo:
    """Add up what several stores have of an item; the rate is that of the largest."""
    largest = max(infos, key=lambda info: info.rows)
    return replace(
        largest,
        rows=sum(info.rows for info in infos),
        first_ns=min(info.first_ns for info in infos),
        last_ns=max(info.last_ns for info in infos),
        bytes=sum(info.bytes for info in infos),
        estimated=any(info.estimated for info in infos),
    )
