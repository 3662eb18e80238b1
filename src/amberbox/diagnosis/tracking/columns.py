"""What conditions read: columns of the record and outputs of monitors, as samples over time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.core.expression_tree import Fault, of_monitors
from amberbox.core.expression_values import element_of
from amberbox.core.samples import Samples
from amberbox.core.types import Batch, IntArray, Ragged, Status


@dataclass(slots=True)
class Column:
    """One address and its samples; ``index`` is the place in a list, None if it is none.

    Up to ``held_ns`` everything is there already: after ``resume`` such rows come again.
    """

    item: str
    variable: str
    index: int | None
    samples: Samples = field(default_factory=Samples)
    held_ns: int | None = None

    @classmethod
    def of(cls, address: str) -> Column:
        """Take an address apart: ``item.variable[17]``."""
        item, _, variable = address.partition(".")
        name, bracket, place = variable.partition("[")
        return cls(item, name, int(place.rstrip("]")) if bracket else None)

    def extend(self, times_ns: IntArray, values: Any) -> None:
        """Take values, without those that are held already."""
        if self.held_ns is not None and len(times_ns) and times_ns[0] <= self.held_ns:
            new = times_ns > self.held_ns
            times_ns, values = times_ns[new], values[new]
        self.samples.extend(times_ns, values)


class Columns:
    """All columns that are read, by address; ``keep_ns`` is how far back they reach."""

    def __init__(self, addresses: Iterable[str], keep_ns: int) -> None:
        self.keep_ns = keep_ns
        self.of_record: dict[str, Column] = {}
        self.of_monitors: dict[str, Samples] = {}
        self._by_item: dict[str, list[Column]] = {}
        self._by_mode: dict[tuple[str, str], list[tuple[str, Samples]]] = {}
        for address in addresses:
            said = of_monitors(address)
            if said is None:
                self._add_column(address)
            else:
                self._add_said(address, *said)

    def _add_said(self, address: str, component: str, mode: str, output: str = "") -> None:
        """Add an output, or where none is named a status."""
        samples = self.of_monitors[address] = Samples()
        self._by_mode.setdefault((component, mode), []).append((output, samples))

    def _add_column(self, address: str) -> None:
        column = self.of_record[address] = Column.of(address)
        self._by_item.setdefault(column.item, []).append(column)

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose rows are read; child tables come with the item above them."""
        return frozenset(name for item in self._by_item for name in _with_parents(item))

    def samples(self) -> dict[str, Samples]:
        """Return all samples by address."""
        return {name: column.samples for name, column in self.of_record.items()} | self.of_monitors

    def feed(self, batch: Batch) -> None:
        """Take rows; their log times do not decrease."""
        for each in _with_children(batch):
            for column in self._by_item.get(each.item, ()):
                if column.index is None or "parent_seq" not in each.columns:
                    column.extend(each.log_time_ns, _values(each, column.variable, column.index))
                else:
                    column.extend(batch.log_time_ns, _of_rows(column, batch, each))

    def take(self, status: Status) -> None:
        """Take what the level of a mode or component and its outputs are."""
        for output, samples in self._by_mode.get((status.component, status.mode), ()):
            value = status.outputs.get(output) if output else status.level
            samples.extend(np.array([status.measured_ns], np.int64), _single(value))

    def forget(self) -> None:
        """Forget everything, as at the beginning of an epoch."""
        for samples in self.of_monitors.values():
            samples.clear()
        for column in self.of_record.values():
            column.samples.clear()
            column.held_ns = None

    def forget_before(self, until_ns: int) -> None:
        """Forget what no longer matters at ``until_ns`` and later."""
        for samples in self.samples().values():
            samples.forget_before(until_ns - self.keep_ns)

    def snapshot(self, until_ns: int) -> dict[str, Any]:
        """Return what is older than the rows that will be read again, and all of monitors."""
        held = {a: _last_by(c.samples, until_ns - self.keep_ns) for a, c in self.of_record.items()}
        return {
            "columns": {address: sample for address, sample in held.items() if sample is not None},
            "outputs": {address: _pairs(s) for address, s in self.of_monitors.items()},
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on with what ``snapshot`` returned."""
        self.forget()
        for address, (at_ns, value) in snapshot["columns"].items():
            column = self.of_record[address]
            column.samples.extend(np.array([at_ns], np.int64), _single(_of_json(value)))
            column.held_ns = at_ns
        for address, pairs in snapshot["outputs"].items():
            for at_ns, value in pairs:
                array = _single(_of_json(value))
                self.of_monitors[address].extend(np.array([at_ns], np.int64), array)


def _values(batch: Batch, name: str, index: int | None) -> Any:
    """Return a column of a batch; unknown where it does not have what is asked for."""
    column = batch.columns.get(name)
    if column is None or (index is None and isinstance(column, Ragged)):
        return _unknown(len(batch))
    if index is None:
        return column
    try:
        values = element_of(column, index, 0)
    except Fault:
        return _unknown(len(batch))
    return values.column()


def _of_rows(column: Column, messages: Batch, rows: Batch) -> Any:
    """Return one row of each message's list of structures; unknown where the list is shorter."""
    here = np.flatnonzero(np.asarray(rows.columns["index"]) == column.index)
    found = _values(rows, column.variable, None)[here]
    if np.ma.getdata(found).dtype == object:
        values: Any = np.full(len(messages), None, object)
    else:
        values = _unknown(len(messages), np.ma.getdata(found).dtype)
    values[messages.seq.searchsorted(np.asarray(rows.columns["parent_seq"])[here])] = found
    return values


def _unknown(count: int, dtype: Any = np.float64) -> Any:
    return np.ma.MaskedArray(np.zeros(count, dtype), np.ones(count, bool))


def _single(value: Any) -> Any:
    return np.array([value], object if value is None or isinstance(value, str) else None)


def _pairs(samples: Samples) -> list[list[Any]]:
    plain = samples.column().tolist()
    return [[at, _as_json(v)] for at, v in zip(samples.times_ns.tolist(), plain, strict=True)]


def _last_by(samples: Samples, time_ns: int) -> list[Any] | None:
    last = int(samples.last(time_ns))
    if last < 0:
        return None
    value = samples.column()[last : last + 1].tolist()[0]
    return [int(samples.times_ns[last]), _as_json(value)]


def _as_json(value: Any) -> Any:
    """JSON has no NaN and no infinity: such a number stands in a list of its own."""
    return [repr(value)] if isinstance(value, float) and not math.isfinite(value) else value


def _of_json(kept: Any) -> Any:
    return float(kept[0]) if isinstance(kept, list) else kept


def _with_children(batch: Batch) -> Iterator[Batch]:
    yield batch
    for child in batch.children.values():
        yield from _with_children(child)


def _with_parents(item: str) -> Iterator[str]:
    yield item
    while "__" in item:
        item = item.rpartition("__")[0]
        yield item
