"""Open a record and ask it: items, variables, rows of a time range, gaps, events."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query import gaps as gap_list
from amberbox.blackbox.query.catalogue import Answer, Catalogue, ask
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.blackbox.query.downsample import downsample
from amberbox.blackbox.query.gather import Gathered, Merged, Request, gather, merge
from amberbox.blackbox.query.overview import ItemInfo, overview
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.variables import Wanted, resolve, select
from amberbox.blackbox.segments import columns as col
from amberbox.blackbox.segments.build import can_build
from amberbox.blackbox.segments.flat import TableSchema
from amberbox.blackbox.segments.restoring import notes as damage_notes
from amberbox.blackbox.store import is_store
from amberbox.blackbox.where import store_path
from amberbox.core.errors import UsageError
from amberbox.core.names import identifier
from amberbox.core.timetext import in_order, parse_time
from amberbox.core.types import Column, ColumnData, Gap, ItemSchema

if TYPE_CHECKING:
    from amberbox.blackbox.missions import Mission

By = Literal["received", "timestamp"]
Time = int | str | None

_KEYS = {
    "timestamp": "time",
    "received": "time",
    "seq": "int64",
    "parent_seq": "int64",
}


@dataclass(frozen=True)
class Record:
    """A record opened for reading; a live one shows more each time it is asked.

    ``temporary`` holds the store that recording files were imported into; it goes with this
    object, or with ``close``. ``notes`` say what of them,
    or of the store's manifest, could not be read.
    """

    path: Path
    temporary: tempfile.TemporaryDirectory[str] | None = None
    notes: tuple[str, ...] = ()

    def __enter__(self) -> Record:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the temporary store, if there is one."""
        if self.temporary is not None:
            self.temporary.cleanup()

    def items(self) -> list[ItemInfo]:
        """Return what was recorded: each data item and child table with rows, rates, times."""
        return self._ask(overview)

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item: the union over all versions of its schema.

        Raises UsageError for an item that is not there.
        """
        schema = self._ask(lambda catalogue: catalogue.schema(item))
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
        """Return ``timestamp`` and variables of an item for ``[from_, to)``, in order of time.

        Times are nanoseconds since the Unix epoch or texts (ISO, epoch, ``-10m``, ``now``).
        Without ``variables`` the table has the ones chosen in ``black_box.yaml``, else all;
        ``received`` and ``seq`` come when named. ``points`` thins out, keeping extremes. Without
        pyarrow the journals are read instead of the segments: slower, with the same result.
        With ``missions`` the ranges are theirs; of several, a column ``mission`` tells which.

        Raises UsageError for unknown or ambiguous names, for times that cannot be read, and for a
        range that ends before it begins.
        """
        if missions is not None:
            from amberbox.blackbox.missions.windows import query_missions

            return query_missions(
                missions, lambda start, end: self.query(item, variables, start, end, by, points)
            )
        span = self.span_ns(from_, to)
        return self._ask(lambda c: query_tables(c, item, variables, span, by, points))

    def time_ns(self, moment: Time) -> int | None:
        """Read a time as ``query`` does; ``-10m`` counts from the last record."""
        if not isinstance(moment, str):
            return moment
        return parse_time(moment, time.time_ns, self.last_ns)

    def span_ns(self, from_: Time, to: Time) -> tuple[int | None, int | None]:
        """Read both ends of a range; raises UsageError if it ends before it begins."""
        return in_order(self.time_ns(from_), self.time_ns(to))

    def last_ns(self) -> int | None:
        """Return when the last record was received; None in an empty store."""
        return self._ask(gap_list.last_received_ns)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return what is missing in ``[from_, to)`` and why, of one item or of all."""
        span = self.span_ns(from_, to)
        return self._ask(lambda catalogue: gap_list.gaps(catalogue, item, span))

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[Mission]:
        """Return missions in order of their start: of a name, failed ones, the last few."""
        from amberbox.blackbox.missions import choose, load

        return choose(load(self.path), name, failed=failed, last=last)

    def drawn(
        self, item: str, variables: Sequence[str], span: tuple[Time, Time], by: By, points: int
    ) -> tuple[Table, bool]:
        """Return the rows that a plot of so many points is made of; whether these are all."""
        return self.query(item, variables, *span, by), True

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """Return the ranges of an incident (its id, or ``last``), in order.

        Raises UsageError when there is none.
        """
        from amberbox.blackbox.incidents.incident import chosen
        from amberbox.blackbox.incidents.window import windows_of
        from amberbox.blackbox.store import open_store

        return windows_of(self, chosen(open_store(self.path), incident))

    def clock(self) -> ClockBook:
        """Return what is known by now of the clocks of each boot, and what cannot be put right."""
        return self._ask(lambda catalogue: catalogue.book)

    def sql(self, statement: str) -> Table:
        """Answer a SELECT: each item and child table is a view (see ``blackbox.sql``)."""
        from amberbox.blackbox.query.sql import run_sql

        return self._ask(lambda catalogue: run_sql(catalogue, statement))

    def events(self, from_: Time = None, to: Time = None) -> Table:
        """Return what happened to the box: its event channel as a table."""
        name, span = identifier(reserved.EVENT), self.span_ns(from_, to)
        if not self._ask(lambda catalogue: name in catalogue.schemas):
            return Table("events", (Column("timestamp", "timestamp", "time"),),
                         {"timestamp": np.empty(0, np.int64)})  # fmt: skip
        return self.query(name, None, *span)

    def _ask(self, question: Callable[[Catalogue], Answer]) -> Answer:
        return ask(self.path, question, with_segments=can_build())


def open(where: str | Path) -> Record:
    """Open a robot folder, a store, or a recording (bag, MCAP, ULog, CSV, mongodump), for reading.

    Raises UsageError when there is none of these at ``where``.
    """
    path = Path(where)
    if _is_recording(path):
        return _import(path)
    store = store_path(path)
    return Record(store, notes=tuple(damage_notes(store)))


def _is_recording(path: Path) -> bool:
    if is_store(path) or (path / "robot.yaml").exists() or (path / "black_box.yaml").exists():
        return False
    bag, dump = path / "metadata.yaml", path.glob("*.bson*")
    return path.is_file() or bag.is_file() or next(dump, None) is not None


def _import(path: Path) -> Record:
    from amberbox.blackbox.importing import import_recordings

    folder = tempfile.TemporaryDirectory(prefix="amberbox-")
    store = Path(folder.name) / "store"
    (report,) = import_recordings([path], store)
    return Record(store, folder, (*(f"damaged: {text}" for text in report.damage), *report.notes))


class Tables(Protocol):
    """What a query asks before it reads rows: a catalogue of one store, or of several."""

    def schema(self, table: str) -> TableSchema:
        """Return a table's columns; raises UsageError for one that is not there."""

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """Return the variables configured for each item."""


def query_tables(
    catalogue: Catalogue,
    item: str,
    names: Sequence[str] | None,
    span: tuple[int | None, int | None],
    by: By,
    points: int | None,
) -> Table:
    """Answer a query from one store (see ``Record.query``)."""
    return answer(catalogue, partial(gather, catalogue), item, names, span, by, points)


def answer(
    catalogue: Tables,
    read: Callable[[Request], Gathered],
    item: str,
    names: Sequence[str] | None,
    span: tuple[int | None, int | None],
    by: By,
    points: int | None,
) -> Table:
    """Answer a query with the rows that ``read`` gives."""
    if by not in ("received", "timestamp"):
        raise UsageError(f"rows are ordered by received or timestamp, not by {by!r}")
    if points is not None and points < 1:
        raise UsageError("points must be 1 or more")
    schema = catalogue.schema(item)
    wanted = wanted_columns(catalogue, schema, names)
    needed = needed_columns(wanted)
    found = read(Request(schema.item, needed, span, by))
    notes = [*found.notes, *(f"{gap.item or gap.writer}: {gap.reason}" for gap in found.gaps)]
    table = make_table(schema, wanted, merge(found.pieces, schema, needed, by), notes)
    return table if points is None else _thinned(table, points)


def needed_columns(wanted: Sequence[Wanted]) -> list[str]:
    """Name the variables that have to be read."""
    return list(dict.fromkeys(w.column.name for w in wanted if w.column.name not in _KEYS))


def wanted_columns(
    catalogue: Tables, schema: TableSchema, names: Sequence[str] | None
) -> list[Wanted]:
    """Say which columns to show: timestamp first, then what was named or configured."""
    keys = {name: Wanted(name, Column(name, name, kind)) for name, kind in _KEYS.items()}
    if not schema.parent:
        del keys["parent_seq"]
    if names is None:
        shown = [Wanted(c.name, c) for c in _configured(catalogue, schema)]
        first = ["timestamp", "parent_seq"] if schema.parent else ["timestamp"]
        return [*(keys[name] for name in first), *shown]
    found = {"timestamp": keys["timestamp"]}
    for name in names:
        key = keys.get(name)
        for wanted in [key] if key else resolve(schema.columns, [name], schema.item):
            found.setdefault(wanted.name, wanted)
    return list(found.values())


def _configured(catalogue: Tables, schema: TableSchema) -> Sequence[Column]:
    if schema.parent:
        return schema.columns
    chosen = catalogue.selection.get(schema.item, [])
    return select(schema.columns, chosen) or schema.columns


def make_table(
    schema: TableSchema, wanted: Sequence[Wanted], rows: Merged, notes: Sequence[str] = ()
) -> Table:
    """Put the columns that were asked for into a table, elements of lists picked out."""
    fields = tuple(_field(w) for w in wanted)
    columns = {w.name: _values(w, rows) for w in wanted}
    return Table(schema.item, fields, columns, tuple(dict.fromkeys(notes)))


def _field(wanted: Wanted) -> Column:
    if wanted.element is None:
        return wanted.column
    kind = col.element_type(wanted.column.type) or wanted.column.type
    return replace(wanted.column, name=wanted.name, type=kind)


def _values(wanted: Wanted, rows: Merged) -> ColumnData:
    keys: dict[str, Any] = {
        "timestamp": rows.timestamp_ns,
        "received": rows.received_ns,
        "seq": rows.seq,
        "parent_seq": rows.seq,
    }
    name = wanted.column.name
    if name in keys:
        return keys[name]  # type: ignore[no-any-return]  # one of the arrays above
    column = rows.columns[name]
    return column if wanted.element is None else col.element(column, wanted.element)


def _thinned(table: Table, points: int) -> Table:
    variables = [table.columns[name] for name in table.names if name not in _KEYS]
    return table.take(downsample(variables, len(table), points))
