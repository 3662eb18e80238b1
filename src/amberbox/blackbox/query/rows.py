"""Answer a query: rows of a time range or of missions, with the columns that were named."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.columns.variables import SelectedColumn, configured_columns, resolve_columns
from amberbox.blackbox.query.table import Table, downsample
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.blackbox.store.table_reader import GatheredRows, MergedRows, RowRequest, gather, merge
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, ColumnData

if TYPE_CHECKING:
    from amberbox.blackbox.retention.missions import RecordedMission

By = Literal["received", "timestamp"]

_KEYS = {
    "timestamp": "time",
    "received": "time",
    "seq": "int64",
    "parent_seq": "int64",
}


class TableCatalogue(Protocol):
    """The tables available to a query: a catalogue of one store, or of several."""

    def schema(self, table: str) -> TableSchema:
        """Return a table's columns; raises UsageError for an unknown table."""

    @property
    def selection(self) -> Mapping[str, Sequence[str]]:
        """Return the variables configured for each item."""


def query_tables(
    catalogue: StoreCatalogue,
    item: str,
    names: Sequence[str] | None,
    span: tuple[int | None, int | None],
    by: By,
    points: int | None,
) -> Table:
    """Return the table of a query of one store (see ``Record.query``)."""
    return answer(catalogue, partial(gather, catalogue), item, names, span, by, points)


def answer(
    catalogue: TableCatalogue,
    read: Callable[[RowRequest], GatheredRows],
    item: str,
    names: Sequence[str] | None,
    span: tuple[int | None, int | None],
    by: By,
    points: int | None,
) -> Table:
    """Return the table of a query with the rows that ``read`` returns."""
    check_order(by, points)
    schema = catalogue.schema(item)
    wanted = wanted_columns(catalogue, schema, names)
    needed = needed_columns(wanted)
    found = read(RowRequest(schema.item, needed, span, by))
    notes = [*found.notes, *(f"{gap.item or gap.writer}: {gap.reason}" for gap in found.gaps)]
    table = make_table(schema, wanted, merge(found.pieces, schema, needed, by), notes)
    return table if points is None else _thinned(table, points)


def check_order(by: str, points: int | None) -> None:
    """Raise UsageError for an invalid order of rows or number of points."""
    if by not in ("received", "timestamp"):
        raise UsageError(f"rows are ordered by received or timestamp, not by {by!r}")
    if points is not None and points < 1:
        raise UsageError("points must be 1 or more")


def needed_columns(wanted: Sequence[SelectedColumn]) -> list[str]:
    """Return the variables that have to be read."""
    return list(dict.fromkeys(w.column.name for w in wanted if w.column.name not in _KEYS))


def wanted_columns(
    catalogue: TableCatalogue, schema: TableSchema, names: Sequence[str] | None
) -> list[SelectedColumn]:
    """Return the columns to show: timestamp first, then those named or configured."""
    keys = {name: SelectedColumn(name, Column(name, name, kind)) for name, kind in _KEYS.items()}
    if not schema.parent:
        del keys["parent_seq"]
    if names is None:
        shown = [SelectedColumn(c.name, c) for c in _configured(catalogue, schema)]
        first = ["timestamp", "parent_seq"] if schema.parent else ["timestamp"]
        return [*(keys[name] for name in first), *shown]
    found = {"timestamp": keys["timestamp"]}
    for name in names:
        key = keys.get(name)
        for wanted in [key] if key else resolve_columns(schema.columns, [name], schema.item):
            found.setdefault(wanted.name, wanted)
    return list(found.values())


def _configured(catalogue: TableCatalogue, schema: TableSchema) -> Sequence[Column]:
    if schema.parent:
        return schema.columns
    chosen = catalogue.selection.get(schema.item, [])
    return configured_columns(schema.columns, chosen) or schema.columns


def make_table(
    schema: TableSchema,
    wanted: Sequence[SelectedColumn],
    rows: MergedRows,
    notes: Sequence[str] = (),
) -> Table:
    """Return a table of the wanted columns, with elements of lists picked out."""
    fields = tuple(_field(w) for w in wanted)
    columns = {w.name: _values(w, rows) for w in wanted}
    return Table(schema.item, fields, columns, tuple(dict.fromkeys(notes)))


def _field(wanted: SelectedColumn) -> Column:
    if wanted.element is None:
        return wanted.column
    kind = col.element_type(wanted.column.type) or wanted.column.type
    return replace(wanted.column, name=wanted.name, type=kind)


def _values(wanted: SelectedColumn, rows: MergedRows) -> ColumnData:
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


MISSION = "mission"


def query_missions(
    missions: Sequence[RecordedMission], query: Callable[[int, int | None], Table]
) -> Table:
    """Return the rows of each mission; for several, a column ``mission`` holds their ids.

    ``query`` returns the rows of ``[from, to)``. Raises UsageError when there is no mission.
    """
    if not missions:
        raise UsageError("no mission was chosen", "record.missions() lists them")
    tables = [query(mission.from_ns, mission.to_ns) for mission in missions]
    if len(tables) == 1:
        return tables[0]
    first, *others = tables[0].fields
    name = MISSION if MISSION not in tables[0].names else f"{MISSION}_id"
    ids = [np.full(len(t), m.id, object) for t, m in zip(tables, missions, strict=True)]
    columns: dict[str, ColumnData] = {first.name: _joined(tables, first.name)}
    columns[name] = np.concatenate(ids)
    columns |= {field.name: _joined(tables, field.name) for field in others}
    notes = dict.fromkeys(note for table in tables for note in table.notes)
    fields = (first, Column(name, name, "string"), *others)
    return replace(tables[0], fields=fields, columns=columns, notes=tuple(notes))


def _joined(tables: Sequence[Table], name: str) -> ColumnData:
    return col.concatenate([table.columns[name] for table in tables])
