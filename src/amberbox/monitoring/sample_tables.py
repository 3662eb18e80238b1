"""Tables of samples, counters and gaps of the record, one for each item that monitors read.

Lists of numbers, such as the ranges of a scan, are kept as a few figures per row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.blackbox.journal import channels
from amberbox.core.clock import NS
from amberbox.core.conditions import (
    batch_and_children,
    batch_column,
    child_row_column,
    from_json,
    last_sample,
    single_value,
    unknown_column,
)
from amberbox.core.flow import NONE_OPEN, Flow, Stalls
from amberbox.core.mode import Input
from amberbox.core.names import identifier, with_parents
from amberbox.core.samples import Samples
from amberbox.core.types import Batch, IntArray, ItemSchema, Ragged
from amberbox.monitoring.plan import InputPlan

# of a list: its length, how many are finite, and figures of these
FIGURES = ("count", "finite", "min", "max", "mean")


def figures_of(column: Any, rows: int) -> Mapping[str, Any]:
    """Return each figure as a column; unknown for rows without such a list."""
    if not isinstance(column, Ragged) or column.values.dtype.kind not in "biuf":
        unknown = np.ma.MaskedArray(np.zeros(rows), np.ones(rows, bool))
        return dict.fromkeys(FIGURES, unknown)
    values = column.values[: column.offsets[-1]].astype(np.float64)
    finite = np.isfinite(values)
    starts, counts = column.offsets[:-1], np.diff(column.offsets)
    number = _reduced(np.add, finite.astype(np.float64), starts, counts, 0.0)
    total = _reduced(np.add, np.where(finite, values, 0.0), starts, counts, 0.0)
    with np.errstate(all="ignore"):
        mean = total / number
    low = _reduced(np.minimum, np.where(finite, values, np.inf), starts, counts, np.inf)
    high = _reduced(np.maximum, np.where(finite, values, -np.inf), starts, counts, -np.inf)
    none = number == 0
    return {
        "count": counts.astype(np.float64),
        "finite": number,
        "min": np.where(none, np.nan, low),
        "max": np.where(none, np.nan, high),
        "mean": mean,
    }


def _reduced(function: np.ufunc, values: Any, starts: Any, counts: Any, empty: float) -> Any:
    """Reduce the values of each row; ``empty`` where there are none."""
    found = np.full(len(starts), empty)
    some = counts > 0
    if some.any():
        found[some] = function.reduceat(values, starts[some])
    return found


COUNTERS = identifier(channels.COUNTERS)
GAPS = identifier(channels.GAP)

Key = tuple[str, int | None]  # column; or element of a list, or row of a child table


@dataclass(slots=True)
class SampleTable:
    """One item: the columns that are read, the times of rows, and the counts of received
    messages.
    """

    item: str
    flow: Flow = field(default_factory=Flow)
    stamps: Samples = field(default_factory=Samples)
    columns: dict[Key, Samples] = field(default_factory=dict)
    lists: dict[str, Mapping[str, Samples]] = field(default_factory=dict)
    whole: dict[str, Samples] | None = None
    """All columns, where they are wanted."""
    labels: dict[str, dict[int, str]] = field(default_factory=dict)
    """Names of values, as defined by the message, for the columns that are read."""
    keep_ns: int = NS
    is_list: bool = False
    """Whether it is a list of structures within the messages of another item."""
    fresh: list[IntArray] = field(default_factory=list)
    """Times of rows that no instant has been evaluated for yet."""
    _schema: ItemSchema | None = None
    _gaps: dict[tuple[str, int], int] = field(default_factory=dict)
    _held_ns: dict[str, int] = field(default_factory=dict)
    """Time up to which all rows are stored already, after ``resume``: such rows are read again."""

    def feed(self, batch: Batch, after_ns: int) -> None:
        """Add the rows of a batch that are later than those held."""
        times_ns = batch.log_time_ns
        keep = self._new("rows", times_ns)
        if keep is not None:
            times_ns = times_ns[keep]
        if not len(times_ns):
            return
        rows = self.flow.rows
        before = int(rows.values[-1]) if len(rows) else 0
        rows.extend(times_ns, np.arange(before + 1, before + 1 + len(times_ns)))
        self._take_labels(batch.schema)
        if batch.schema.stamp:
            self.stamps.extend(times_ns, _part(batch.timestamp_ns, keep))
        for key, samples in self.columns.items():
            if key[1] is None or "parent_seq" not in batch.columns:  # else one row of a list
                samples.extend(times_ns, _part(batch_column(batch, *key), keep))
        for name, figures in self.lists.items():
            for figure, values in figures_of(batch.columns.get(name), len(batch)).items():
                figures[figure].extend(times_ns, _part(values, keep))
        if self.whole is not None:
            self._take_all(self.whole, batch, times_ns, keep)
        if times_ns[-1] > after_ns:
            self.fresh.append(times_ns[times_ns > after_ns])

    def _take_labels(self, schema: ItemSchema) -> None:
        if schema is self._schema:
            return
        self._schema = schema
        for column in schema.columns:
            if column.name in self.labels:
                self.labels[column.name].update(column.labels)

    def feed_rows(self, messages: Batch, rows: Batch | None) -> None:
        """Add single rows of a list of structures: unknown in messages whose list lacks them."""
        self.is_list |= rows is not None and "index" in rows.columns
        for (name, index), samples in self.columns.items() if self.is_list else ():
            if index is None:
                continue
            times_ns, values = messages.log_time_ns, _row_values(messages, rows, name, index)
            first = 0 if len(samples) else _first_known(values)
            keep = self._new(f"column {name} {index}", times_ns[first:])
            samples.extend(_part(times_ns[first:], keep), _part(values[first:], keep))

    def _take_all(
        self, whole: dict[str, Samples], batch: Batch, times_ns: IntArray, keep: Any
    ) -> None:
        for name, column in batch.columns.items():
            if not isinstance(column, Ragged) and name not in whole:
                whole[name] = Samples()
        for name, samples in whole.items():
            samples.extend(times_ns, _part(batch_column(batch, name), keep))

    def count(self, times_ns: IntArray, received: IntArray, last_ns: IntArray) -> None:
        """Add counts of the recorder."""
        keep = self._new("received", times_ns)
        times_ns = _part(times_ns, keep)
        self.flow.received.extend(times_ns, _part(received, keep))
        self.flow.last_ns.extend(times_ns, _part(last_ns, keep))

    def gap(self, at_ns: int, peer: str, from_ns: int, is_open: bool, reason: str) -> None:
        """Record that a publisher was lost, or came back."""
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
        """Return the rows that are not held already; None for all of them."""
        held_ns = self._held_ns.get(what)
        if held_ns is None or not len(times_ns) or times_ns[0] > held_ns:
            return None
        return times_ns > held_ns

    def samples(self) -> Iterator[tuple[str, Samples]]:
        """Yield all samples held, each with its name."""
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
        """Forget the samples not needed at ``time_ns`` and later."""
        for _, samples in self.samples():
            samples.forget_before(time_ns - self.keep_ns)

    def snapshot(self, at_ns: int) -> dict[str, Any]:
        """Return the samples older than the rows that will be read again, and open gaps."""
        held = {
            name: last_sample(samples, at_ns - self.keep_ns) for name, samples in self.samples()
        }
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
                samples.extend(np.array([held[0]]), single_value(from_json(held[1])))
                self._held_ns[name] = held[0]

    def forget(self) -> None:
        """Forget everything, as at the beginning of an epoch."""
        for _, samples in self.samples():
            samples.clear()
        self.fresh.clear()
        self._gaps.clear()
        self.flow.reasons.clear()
        self._held_ns.clear()


class SampleTables:
    """The tables of all items that a plan reads."""

    def __init__(self) -> None:
        self._tables: dict[str, SampleTable] = {}
        self._families: dict[str, list[SampleTable]] = {}
        self.stalls = Stalls()
        """When the recorder was held up."""

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items whose batches are needed."""
        parents = {name for item in self._tables for name in with_parents(item)}
        return frozenset(parents | {COUNTERS, GAPS})

    def __iter__(self) -> Iterator[SampleTable]:
        return iter(self._tables.values())

    def input(self, plan: InputPlan, history_s: float, parts: bool) -> Input:
        """Return the input of a mode, which grows as rows are added."""
        table = self._tables.setdefault(plan.item, SampleTable(plan.item))
        table.flow.stalls = self.stalls
        table.keep_ns = max(table.keep_ns, round((history_s + 1.0) * NS))
        return _INPUT[plan.kind](plan, table, parts)

    def table(self, item: str) -> SampleTable:
        """Return the table of an item that is read."""
        return self._tables[item]

    def feed(self, batch: Batch, after_ns: int) -> None:
        """Add a batch and its child tables."""
        if batch.item == COUNTERS:
            self._take_counters(batch)
        elif batch.item == GAPS:
            self._take_gaps(batch)
        else:
            batches = {each.item: each for each in batch_and_children(batch)}
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
        found: dict[str, list[int]] = {}
        for place, name in enumerate(names):
            found.setdefault(name, []).append(place)
        for item, places in {name: np.array(places) for name, places in found.items()}.items():
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

    def _of(self, item: str) -> Iterable[SampleTable]:
        """Return the tables of an item and of its lists of structures; none named means all."""
        if not item:
            return self._tables.values()
        if item not in self._families:
            family = [
                t
                for name, t in self._tables.items()
                if name == item or name.startswith(f"{item}__")
            ]
            self._families[item] = family
        return self._families[item]


def _variable(plan: InputPlan, table: SampleTable, parts: bool) -> Input:
    key = (plan.variable, plan.index)
    samples = table.columns.setdefault(key, Samples())
    labels = table.labels.setdefault(plan.variable, {})
    return Input(plan.text, samples, table.flow, table.stamps, labels=labels)


def _list(plan: InputPlan, table: SampleTable, parts: bool) -> Input:
    figures = table.lists.setdefault(plan.variable, {name: Samples() for name in FIGURES})
    return Input(plan.text, figures["mean"], table.flow, table.stamps, figures)


def _item(plan: InputPlan, table: SampleTable, parts: bool) -> Input:
    if parts and table.whole is None:
        table.whole = {}
    whole = table.whole if parts and table.whole is not None else {}
    return Input(plan.text, table.flow.rows, table.flow, table.stamps, whole)


def _probe(plan: InputPlan, table: SampleTable, parts: bool) -> Input:
    if table.whole is None:
        table.whole = {}
    samples = table.whole.setdefault("ok", Samples())
    return Input(plan.text, samples, table.flow, table.stamps, table.whole)


_INPUT: Mapping[str, Callable[[InputPlan, SampleTable, bool], Input]] = {
    "variable": _variable,
    "list": _list,
    "item": _item,
    "probe": _probe,
}


def _part(column: Any, keep: Any) -> Any:
    return column if keep is None else column[keep]


def _row_values(messages: Batch, rows: Batch | None, name: str, index: int) -> Any:
    """Return a column of one row of each message's list; unknown where there are no lists."""
    if rows is None or not len(rows):
        return unknown_column(len(messages))
    return child_row_column(messages, rows, name, index)


def _first_known(column: Any) -> int:
    known = np.array([value is not None for value in _objects(column)], bool)
    return int(known.argmax()) if known.any() else len(known)


def _objects(column: Any) -> Any:
    if isinstance(column, np.ma.MaskedArray):
        objects = np.ma.getdata(column).astype(object)
        objects[np.ma.getmaskarray(column)] = None
        return objects
    return column
