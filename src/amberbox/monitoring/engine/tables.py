"""What the record says of each item that monitors read: samples, counts, gaps, by item."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.core.clock import NS
from amberbox.core.expression_tree import Fault
from amberbox.core.expression_values import element_of
from amberbox.core.flow import NONE_OPEN, Flow
from amberbox.core.mode import Input
from amberbox.core.names import identifier
from amberbox.core.samples import Samples
from amberbox.core.stalls import Stalls
from amberbox.core.types import Batch, IntArray, ItemSchema, Ragged
from amberbox.monitoring.engine.keeping import as_json, of_json
from amberbox.monitoring.engine.lists import FIGURES, figures_of
from amberbox.monitoring.plan import InputPlan

COUNTERS = identifier(reserved.COUNTERS)
GAPS = identifier(reserved.GAP)

Key = tuple[str, int | None]
"""A column, or an element of a list column, or a column of one row of a child table."""


@dataclass(slots=True)
class Table:
    """One item: the columns that are read, when rows came, how many were received."""

    item: str
    flow: Flow = field(default_factory=Flow)
    stamps: Samples = field(default_factory=Samples)
    columns: dict[Key, Samples] = field(default_factory=dict)
    lists: dict[str, Mapping[str, Samples]] = field(default_factory=dict)
    whole: dict[str, Samples] | None = None
    """All columns, where they are wanted."""
    labels: dict[str, dict[int, str]] = field(default_factory=dict)
    """Names that the message gives values of the columns that are read."""
    keep_ns: int = NS
    is_list: bool = False
    """It is a list of structures within the messages of another item."""
    fresh: list[IntArray] = field(default_factory=list)
    """Times of rows that no instant has been evaluated for yet."""
    _schema: ItemSchema | None = None
    _gaps: dict[tuple[str, int], int] = field(default_factory=dict)
    _held_ns: dict[str, int] = field(default_factory=dict)
    """Up to when everything is held already, after ``resume``: such rows come again."""

    def feed(self, batch: Batch, after_ns: int) -> None:
        """Take the rows of a batch that are later than what is held."""
        times_ns = batch.log_time_ns
        keep = self._new("rows", times_ns)
        if keep is not None:
            times_ns = times_ns[keep]
        if not len(times_ns):
            return
        self._count_rows(times_ns)
        self._take_labels(batch.schema)
        if batch.schema.stamp:
            self.stamps.extend(times_ns, _part(batch.timestamp_ns, keep))
        for key, samples in self.columns.items():
            if not _is_row(batch, key):
                samples.extend(times_ns, _part(self._column(batch, *key), keep))
        for name, figures in self.lists.items():
            for figure, values in figures_of(batch.columns.get(name), len(batch)).items():
                figures[figure].extend(times_ns, _part(values, keep))
        if self.whole is not None:
            self._take_all(self.whole, batch, times_ns, keep)
        if times_ns[-1] > after_ns:
            self.fresh.append(times_ns[times_ns > after_ns])

    def _count_rows(self, times_ns: IntArray) -> None:
        rows = self.flow.rows
        before = int(rows.values[-1]) if len(rows) else 0
        rows.extend(times_ns, np.arange(before + 1, before + 1 + len(times_ns)))

    def _take_labels(self, schema: ItemSchema) -> None:
        if schema is self._schema:
            return
        self._schema = schema
        for column in schema.columns:
            if column.name in self.labels:
                self.labels[column.name].update(column.labels)

    def feed_rows(self, messages: Batch, rows: Batch | None) -> None:
        """Take single rows of a list of structures: unknown in messages whose list lacks them."""
        self.is_list |= rows is not None and "index" in rows.columns
        for (name, index), samples in self.columns.items() if self.is_list else ():
            if index is None:
                continue
            times_ns, values = messages.log_time_ns, self._rows_at(index, name, messages, rows)
            first = 0 if len(samples) else _first_known(values)
            keep = self._new(f"column {name} {index}", times_ns[first:])
            samples.extend(_part(times_ns[first:], keep), _part(values[first:], keep))

    def _rows_at(self, index: int, name: str, messages: Batch, rows: Batch | None) -> Any:
        """Return a column of one row of each message's list."""
        if rows is None or not len(rows):
            return _unknown(len(messages))
        here = np.flatnonzero(np.asarray(rows.columns["index"]) == index)
        column = self._column(rows, name, None)[here]
        values = _unknown(len(messages), column.dtype)
        places = messages.seq.searchsorted(np.asarray(rows.columns["parent_seq"])[here])
        values[places] = column
        return values

    def _column(self, batch: Batch, name: str, index: int | None) -> Any:
        column = batch.columns.get(name)
        if column is None:
            return _unknown(len(batch))
        if index is None:
            return column if not isinstance(column, Ragged) else _unknown(len(batch))
        try:
            values = element_of(column, index, 0)
        except Fault:
            return _unknown(len(batch))
        return np.ma.MaskedArray(values.data, values.null)

    def _take_all(
        self, whole: dict[str, Samples], batch: Batch, times_ns: IntArray, keep: Any
    ) -> None:
        for name, column in batch.columns.items():
            if not isinstance(column, Ragged) and name not in whole:
                whole[name] = Samples()
        for name, samples in whole.items():
            samples.extend(times_ns, _part(self._column(batch, name, None), keep))

    def count(self, times_ns: IntArray, received: IntArray, last_ns: IntArray) -> None:
        """Take what the recorder counted."""
        keep = self._new("received", times_ns)
        times_ns = _part(times_ns, keep)
        self.flow.received.extend(times_ns, _part(received, keep))
        self.flow.last_ns.extend(times_ns, _part(last_ns, keep))

    def gap(self, at_ns: int, peer: str, from_ns: int, is_open: bool, reason: str) -> None:
        """Take note that a publisher was lost, or came back."""
        if at_ns <= self._held_ns.get("gap", -1):
            return
        if is_open:
            self._gaps[peer, from_ns] = from_ns
            self.flow.reasons[from_ns] = reason
        else:
            self._gaps.pop((peer, from_ns), None)
        newest = max(self._gaps.values(), default=NONE_OPEN)
        self.flow.gap_from_ns.extend(np.array([at_ns]), np.array([newest]))

    def _new(self, what: str, times_ns: IntArray) -> Any:
        """Choose the rows that are not held already; None for all of them."""
        held_ns = self._held_ns.get(what)
        if held_ns is None or not len(times_ns) or times_ns[0] > held_ns:
            return None
        return times_ns > held_ns

    def samples(self) -> Iterator[tuple[str, Samples]]:
        """Name everything that is held."""
        flow = self.flow
        yield from (("received", flow.received), ("last", flow.last_ns), ("rows", flow.rows))
        yield from (("gap", flow.gap_from_ns), ("stamps", self.stamps))
        for (name, index), samples in self.columns.items():
            yield f"column {name} {index}", samples
        for name, figures in self.lists.items():
            for figure, samples in figures.items():
                yield f"list {name} {figure}", samples
        for name, samples in (self.whole or {}).items():
            yield f"whole {name}", samples

    def forget_before(self, time_ns: int) -> None:
        """Forget what no longer matters at ``time_ns`` and later."""
        for _, samples in self.samples():
            samples.forget_before(time_ns - self.keep_ns)

    def snapshot(self, at_ns: int) -> dict[str, Any]:
        """Return what is older than the rows that will be read again, and open gaps."""
        held = {name: _last_by(samples, at_ns - self.keep_ns) for name, samples in self.samples()}
        gaps = [[peer, at, self.flow.reasons.get(at, "")] for peer, at in self._gaps]
        known = {n: v for n, v in held.items() if v is not None}
        return {"held": known, "gaps": gaps, "is_list": self.is_list}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on with what ``snapshot`` returned."""
        self.is_list = snapshot["is_list"]
        self._gaps = {(peer, from_ns): from_ns for peer, from_ns, _ in snapshot["gaps"]}
        self.flow.reasons.update({from_ns: why for _, from_ns, why in snapshot["gaps"]})
        if self.whole is not None:
            names = [n.removeprefix("whole ") for n in snapshot["held"] if n.startswith("whole ")]
            for name in names:  # inputs hold on to those that are there
                self.whole.setdefault(name, Samples())
        for name, samples in self.samples():
            held = snapshot["held"].get(name)
            if held is not None:
                samples.extend(np.array([held[0]]), _single(held[1]))
                self._held_ns[name] = held[0]

    def forget(self) -> None:
        """Forget everything, as at the beginning of an epoch."""
        for _, samples in self.samples():
            samples.clear()
        self.fresh.clear()
        self._gaps.clear()
        self.flow.reasons.clear()
        self._held_ns.clear()


class Tables:
    """The tables of all items that a plan reads."""

    def __init__(self) -> None:
        self._tables: dict[str, Table] = {}
        self._families: dict[str, list[Table]] = {}
        self.stalls = Stalls()
        """When the recorder was held up."""

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose batches are wanted."""
        parents = {name for item in self._tables for name in _with_parents(item)}
        return frozenset(parents | {COUNTERS, GAPS})

    def __iter__(self) -> Iterator[Table]:
        return iter(self._tables.values())

    def input(self, plan: InputPlan, history_s: float, parts: bool) -> Input:
        """Return what a mode reads, which grows as rows come."""
        table = self._tables.setdefault(plan.item, Table(plan.item))
        table.flow.stalls = self.stalls
        table.keep_ns = max(table.keep_ns, round((history_s + 1.0) * NS))
        return _INPUT[plan.kind](plan, table, parts)

    def table(self, item: str) -> Table:
        """Return the table of an item that is read."""
        return self._tables[item]

    def feed(self, batch: Batch, after_ns: int) -> None:
        """Take a batch and its child tables."""
        if batch.item == COUNTERS:
            self._take_counters(batch)
        elif batch.item == GAPS:
            self._take_gaps(batch)
        else:
            self._take_rows(batch, after_ns)

    def _take_rows(self, batch: Batch, after_ns: int) -> None:
        batches = {each.item: each for each in _with_children(batch)}
        for table in self._of(batch.item):
            rows = batches.get(table.item)
            if rows is not None and len(rows):
                table.feed(rows, after_ns)
            if table.item != batch.item:
                table.feed_rows(batch, rows)

    def _take_stalls(self, batch: Batch) -> None:
        names = ("stalled_from_ns", "stalled_to_ns")
        if all(name in batch.columns for name in names):
            columns = (_objects(batch.columns[name]) for name in names)
            for from_ns, to_ns in zip(*columns, strict=True):
                if from_ns is not None and to_ns is not None:
                    self.stalls.add(int(from_ns), int(to_ns))

    def _take_counters(self, batch: Batch) -> None:
        self._take_stalls(batch)
        rows = batch.children.get("items")
        if rows is None:
            return
        # Every table has a column `received` of its own, so a variable of that name has another.
        columns = {column.path: rows.columns[column.name] for column in rows.schema.columns}
        if not {"item", "received", "last_received_ns"} <= columns.keys():
            return
        names: Any = columns["item"]
        counts: list[Any] = [columns[n] for n in ("received", "last_received_ns")]
        for item, places in _places(names).items():
            for table in self._of(item):
                table.count(rows.log_time_ns[places], *(np.ma.getdata(c)[places] for c in counts))

    def _take_gaps(self, batch: Batch) -> None:
        columns = {name: _objects(column) for name, column in batch.columns.items()}
        for row in range(len(batch)):
            values = {name: column[row] for name, column in columns.items()}
            for table in self._of(values["item"]):
                table.gap(
                    int(batch.log_time_ns[row]), values["peer"] or "",
                    int(values["from_ns"]), values["to_ns"] is None, values["reason"] or "",
                )  # fmt: skip

    def _of(self, item: str) -> Iterable[Table]:
        """Return the tables of an item and of its lists of structures; none named means all."""
        if not item:
            return self._tables.values()
        if item not in self._families:
            family = [
                t for name, t in self._tables.items() if name == item or _is_below(name, item)
            ]
            self._families[item] = family
        return self._families[item]


def _variable(plan: InputPlan, table: Table, parts: bool) -> Input:
    key = (plan.variable, plan.index)
    samples = table.columns.setdefault(key, Samples())
    labels = table.labels.setdefault(plan.variable, {})
    return Input(plan.text, samples, table.flow, table.stamps, labels=labels)


def _list(plan: InputPlan, table: Table, parts: bool) -> Input:
    figures = table.lists.setdefault(plan.variable, {name: Samples() for name in FIGURES})
    return Input(plan.text, figures["mean"], table.flow, table.stamps, figures)


def _item(plan: InputPlan, table: Table, parts: bool) -> Input:
    if parts and table.whole is None:
        table.whole = {}
    whole = table.whole if parts and table.whole is not None else {}
    return Input(plan.text, table.flow.rows, table.flow, table.stamps, whole)


def _probe(plan: InputPlan, table: Table, parts: bool) -> Input:
    if table.whole is None:
        table.whole = {}
    samples = table.whole.setdefault("ok", Samples())
    return Input(plan.text, samples, table.flow, table.stamps, table.whole)


_INPUT: Mapping[str, Callable[[InputPlan, Table, bool], Input]] = {
    "variable": _variable,
    "list": _list,
    "item": _item,
    "probe": _probe,
}


def _part(column: Any, keep: Any) -> Any:
    return column if keep is None else column[keep]


def _unknown(count: int, dtype: Any = np.float64) -> Any:
    if np.dtype(dtype).kind == "O":
        return np.full(count, None, object)
    return np.ma.MaskedArray(np.zeros(count, dtype), np.ones(count, bool))


def _first_known(column: Any) -> int:
    known = np.array([value is not None for value in _objects(column)], bool)
    return int(known.argmax()) if known.any() else len(known)


def _objects(column: Any) -> Any:
    if isinstance(column, np.ma.MaskedArray):
        objects = np.ma.getdata(column).astype(object)
        objects[np.ma.getmaskarray(column)] = None
        return objects
    return column


def _places(names: Any) -> dict[str, IntArray]:
    """Return the rows of each name."""
    found: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        found.setdefault(name, []).append(place)
    return {name: np.array(places) for name, places in found.items()}


def _last_by(samples: Samples, time_ns: int) -> list[Any] | None:
    last = int(samples.last(time_ns))
    if last < 0:
        return None
    value = samples.column()[last]
    plain = None if value is np.ma.masked else getattr(value, "item", lambda: value)()
    return [int(samples.times_ns[last]), as_json(plain)]


def _single(held: Any) -> Any:
    value = of_json(held)
    if value is None:
        return _unknown(1)
    if isinstance(value, str):
        return np.array([value], object)
    return np.array([value])


def _with_children(batch: Batch) -> Iterator[Batch]:
    yield batch
    for child in batch.children.values():
        yield from _with_children(child)


def _with_parents(item: str) -> Iterator[str]:
    """Name an item and the items that it may be a child table of."""
    yield item
    while "__" in item:
        item = item.rpartition("__")[0]
        yield item


def _is_row(batch: Batch, key: Key) -> bool:
    """Tell whether a column is that of one row of a list of structures."""
    return key[1] is not None and "parent_seq" in batch.columns


def _is_below(name: str, item: str) -> bool:
    return name.startswith(f"{item}__")
