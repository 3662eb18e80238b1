"""Conditions over a record: samples of what they read, instants to evaluate, edges and spans.

Monitors (a tick of 0.05 s), triggers and missions (0.1 s), the conditions of the FMEA (0.25 s)
and the rules' lookups in a record share it; the tick is an argument. How rows are split into
batches does not matter, and neither does how often conditions are polled: live and replay agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError, did_you_mean
from amberbox.core.expression import Expression, Value
from amberbox.core.expressions.tree import ExpressionFault, of_monitors
from amberbox.core.expressions.values import element_of, values_of
from amberbox.core.names import identifier, with_parents
from amberbox.core.samples import Samples
from amberbox.core.types import Batch, IntArray, Ragged

STATUS_ITEM = "amberbox_status"  # the watcher writes statuses as this item
TICK_NS = NS // 10  # of triggers and missions, where a condition depends on an age
NO_CONDITION = "is no condition: compare it with something, such as: x > 0"

_TICKS_AT_ONCE = 36_000
_SILENCE_NS = 7 * 86_400 * NS  # ticks end after a longer silence: the clock has stepped
_MISSING_NS = 60 * NS  # fields of JSON may come later; a variable missing so long is a problem
_LONG_AGO = -(1 << 62)


def batch_and_children(batch: Batch) -> Iterator[Batch]:
    """Yield a batch and the batches of all its child tables, depth first."""
    yield batch
    for child in batch.children.values():
        yield from batch_and_children(child)


def batch_column(batch: Batch, name: str, index: int | None = None) -> Any:
    """Return a column, or one element of a list column; unknown where the batch lacks it."""
    column = batch.columns.get(name)
    if column is None or (index is None and isinstance(column, Ragged)):
        return unknown_column(len(batch))
    if index is None:
        return column
    try:
        return element_of(column, index, 0).column()
    except ExpressionFault:
        return unknown_column(len(batch))


def child_row_column(messages: Batch, rows: Batch, name: str, index: int) -> Any:
    """Return a column of one row of each message's list of structures.

    It is unknown in messages whose list is shorter.
    """
    here = np.flatnonzero(np.asarray(rows.columns["index"]) == index)
    column = batch_column(rows, name)[here]
    values = unknown_column(len(messages), np.ma.getdata(column).dtype)
    values[messages.seq.searchsorted(np.asarray(rows.columns["parent_seq"])[here])] = column
    return values


def unknown_column(count: int, dtype: Any = np.float64) -> Any:
    """Return a column in which every value is unknown."""
    if np.dtype(dtype).kind == "O":
        return np.full(count, None, object)
    return np.ma.MaskedArray(np.zeros(count, dtype), np.ones(count, bool))


def single_value(value: Any) -> Any:
    """Return a column of one value; None is unknown."""
    return np.array([value], object if value is None or isinstance(value, str) else None)


def last_sample(samples: Samples, time_ns: int) -> list[Any] | None:
    """Return time and JSON value of the last sample at or before a time; None without one."""
    last = int(samples.last(time_ns))
    if last < 0:
        return None
    value = samples.column()[last]
    plain = None if value is np.ma.masked else getattr(value, "item", lambda: value)()
    return [int(samples.times_ns[last]), as_json(plain)]


def as_json(value: Any) -> Any:
    """Return a value that JSON can hold: a number that is not finite is wrapped in a list."""
    return [repr(value)] if isinstance(value, float) and not math.isfinite(value) else value


def from_json(kept: Any) -> Any:
    """Return the value that ``as_json`` has converted."""
    return float(kept[0]) if isinstance(kept, list) else kept


def ticks(step_ns: int, after_ns: int, until_ns: int) -> IntArray:
    """Return the multiples of a step in ``(after, until]``."""
    return np.arange(after_ns // step_ns + 1, until_ns // step_ns + 1, dtype=np.int64) * step_ns


def change_instants(
    expression: Expression, series: Any, since_ns: int, until_ns: int, tick_ns: int = TICK_NS
) -> Iterator[IntArray]:
    """Yield the instants in ``(since, until]`` at which the value may change, in order.

    These are the times of samples, the ends of windows and ``for``, and every tick where the
    expression reads an age.
    """
    times = [series[address][0] for address in expression.addresses()]
    found = [t + delay for t in times for delay in expression.delays_ns()]
    inside = [t[(t > since_ns) & (t <= until_ns)] for t in found]
    changes: IntArray = np.unique(np.concatenate([np.zeros(0, np.int64), *inside]))
    reached_ns = since_ns
    for block in _tick_blocks(times, since_ns, until_ns, tick_ns) if expression.reads_age else ():
        between = changes[(changes > reached_ns) & (changes <= block[-1])]
        yield np.union1d(between, block)
        reached_ns = int(block[-1])
    yield changes[changes > reached_ns]


def _tick_blocks(
    times: Sequence[IntArray], since_ns: int, until_ns: int, tick_ns: int
) -> Iterator[IntArray]:
    """Yield ticks from the first sample on, in blocks of at most an hour of 0.1 s."""
    received = np.unique(np.concatenate(times))
    groups = np.split(received, np.flatnonzero(np.diff(received) > _SILENCE_NS) + 1)
    for group in groups if len(received) else ():
        first = max(int(group[0]), since_ns) // tick_ns + 1
        end = min(int(group[-1]) + _SILENCE_NS, until_ns) // tick_ns + 1
        for start in range(first, end, _TICKS_AT_ONCE):
            stop = min(start + _TICKS_AT_ONCE, end)
            yield np.arange(start, stop, dtype=np.int64) * tick_ns


def rising_edges(values: Any, was_true: bool) -> tuple[Any, bool]:
    """Return where a condition becomes true, and whether it is true at the end.

    Where it is unknown, its last known value counts. Raises UsageError if it is not a condition.
    """
    null = _null(values)
    if np.ma.getdata(values).dtype != bool and not null.all():
        raise UsageError(NO_CONDITION)
    data = np.zeros(len(null), bool)
    data[~null] = np.ma.getdata(values)[~null]
    last = np.maximum.accumulate(np.where(null, -1, np.arange(len(null))))
    true = np.where(last < 0, was_true, data[last])
    before = np.concatenate([[was_true], true[:-1]])
    return true & ~before, bool(true[-1])


def true_spans(times_ns: IntArray, true: Any, end_ns: int) -> Iterator[tuple[int, int]]:
    """Yield the spans in which a condition holds; each value counts until the next instant."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(np.int8)))
    until = np.append(times_ns, end_ns)
    yield from zip(times_ns[edges[::2]].tolist(), until[edges[1::2]].tolist(), strict=True)


@dataclass(frozen=True, slots=True)
class WatchedCondition:
    """An expression to watch; ``asides`` are read at the instants at which it becomes true."""

    when: Expression
    captured: Mapping[str, Expression] = field(default_factory=dict)

    def expressions(self) -> Iterator[Expression]:
        """Yield everything that has to be evaluated."""
        yield self.when
        yield from self.captured.values()


@dataclass(frozen=True, slots=True)
class RisingEdge:
    """An instant at which a condition became true; ``values`` are those captured at that
    instant.
    """

    name: str
    at_ns: int
    values: Mapping[str, Value] = field(default_factory=dict)


class ConditionWatcher:
    """Watches named conditions over recorded variables, outputs and statuses of monitors.

    Addresses are ``item.variable``, ``component/mode/output`` and ``status(component)``. Times are
    those of the batches unless others are given; they must not decrease per item. While a condition
    is unknown, its last known value counts. A condition that cannot be evaluated (a text where a
    number was expected) has an entry in ``problems`` and never becomes true.
    """

    def __init__(self, conditions: Mapping[str, WatchedCondition]) -> None:
        self._conditions = dict(conditions)
        self._samples = {a: _series_of(a) for c in conditions.values() for a in addresses_of(c)}
        self._was_true = dict.fromkeys(conditions, False)
        self._until_ns = _LONG_AGO
        self._last_ns: dict[str, int] = {}  # of each item
        self.problems: dict[str, str] = {}

    @property
    def items(self) -> frozenset[str]:
        """Return the items whose batches are needed: those named, or parents of child tables."""
        found = map(item_of, self._samples)
        return frozenset(name for item in found for name in with_parents(item))

    @property
    def tables(self) -> frozenset[str]:
        """Return the names of the items and child tables that are read."""
        return frozenset(samples.item for samples in self._samples.values())

    def variables(self, table: str) -> list[str]:
        """Return the names of the variables of a table that are read."""
        found = (s.variable for s in self._samples.values() if s.item == table)
        return list(dict.fromkeys(found))

    @property
    def history_ns(self) -> int:
        """Return how far back rows affect the present values, in nanoseconds."""
        depths = (e.history_ns for c in self._conditions.values() for e in c.expressions())
        return max(depths, default=0)

    def add(self, batch: Batch, times_ns: IntArray | None = None) -> None:
        """Add the rows of a batch and of its child tables.

        Rows of an item with the same time are set apart by a nanosecond, so that each counts: a
        writer may have stamped several at once.
        """
        times_ns = batch.received_ns if times_ns is None else times_ns
        if not len(times_ns):
            return
        place = np.arange(len(times_ns))
        first_ns = self._last_ns.get(batch.item, _LONG_AGO) + 1
        apart_ns = np.maximum(np.maximum.accumulate(times_ns - place), first_ns) + place
        self._last_ns[batch.item] = int(apart_ns[-1])
        self._add(batch, apart_ns)

    def _add(self, batch: Batch, times_ns: IntArray) -> None:
        for samples in self._samples.values():
            if samples.item == batch.item:
                try:
                    samples.add(batch, times_ns)
                except (ExpressionFault, UsageError) as error:
                    self.problems.setdefault(samples.address, f"'{samples.address}' {error}")
        for child in batch.children.values():
            place = np.searchsorted(batch.seq, child.seq)
            self._add(child, times_ns[place])

    @property
    def true(self) -> list[str]:
        """Return the names of the conditions whose last known value is true."""
        return [name for name, is_true in self._was_true.items() if is_true]

    def resume(self, true: Iterable[str], at_ns: int = _LONG_AGO) -> None:
        """Continue an earlier watch: these were true, edges up to ``at_ns`` have been returned."""
        self._was_true |= dict.fromkeys(set(true) & self._was_true.keys(), True)
        self._until_ns = at_ns

    def begin_anew(self) -> None:
        """Forget all rows, as at the start of a run, but not which conditions were true."""
        self._samples = {address: _series_of(address) for address in self._samples}
        self._until_ns = _LONG_AGO
        self._last_ns.clear()

    def edges(self, until_ns: int) -> list[RisingEdge]:
        """Return the conditions that became true since the last call, up to ``until_ns``, by time.

        All rows up to then must have been added.
        """
        if until_ns <= self._until_ns:
            return []
        series = {address: samples.series() for address, samples in self._samples.items()}
        found = [e for name in self._conditions for e in self._edges_of(name, series, until_ns)]
        self._until_ns = until_ns
        keep_ns = until_ns - self.history_ns - TICK_NS
        for samples in self._samples.values():
            samples.forget_before(keep_ns)
        return sorted(found, key=lambda edge: edge.at_ns)

    def _edges_of(self, name: str, series: Any, until_ns: int) -> list[RisingEdge]:
        condition = self._conditions[name]
        try:
            at_ns: list[int] = []
            for instants in change_instants(condition.when, series, self._until_ns, until_ns):
                at_ns += self._rising_at(name, condition.when, series, instants)
        except AmberboxError as error:
            self.problems.setdefault(name, error.what)
            return []
        return [
            RisingEdge(name, t, self._captured_values(name, condition, series, t)) for t in at_ns
        ]

    def _rising_at(self, name: str, when: Expression, series: Any, instants: IntArray) -> list[int]:
        if not len(instants):
            return []
        values = when.evaluate_series(series, instants)
        rising, self._was_true[name] = rising_edges(values, self._was_true[name])
        found: list[int] = instants[rising].tolist()
        return found

    def _captured_values(
        self, name: str, condition: WatchedCondition, series: Any, at_ns: int
    ) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for name_of_value, expression in condition.captured.items():
            try:
                found[name_of_value] = expression.evaluate_series(series, at_ns)
            except AmberboxError as error:
                self.problems.setdefault(f"{name}: {name_of_value}", error.what)
                found[name_of_value] = None
        return found


class _AddressSeries:
    """The samples of one address that still matter, with values of the type of their columns.

    They are reported with edges, so a whole number stays one (``core.samples`` widens it).
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self.item, _, variable = address.partition(".")
        path, _, index = variable.partition("[")
        self.variable = identifier(path)
        self._index = int(index.rstrip("]")) if index else None
        self._has_come = False
        self._missing_since_ns: int | None = None
        self._times_ns: list[IntArray] = []
        self._values: list[Any] = []

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Add the values of a batch; a variable that the batch does not have is unknown."""
        column = batch.columns.get(self.variable, np.full(len(times_ns), None, object))
        index = self._index
        values = values_of(column, 0) if index is None else element_of(column, index, 0)
        self._times_ns.append(times_ns)
        self._values.append(values.column())
        self._miss(batch, times_ns)

    def _miss(self, batch: Batch, times_ns: IntArray) -> None:
        """Raise UsageError if messages of the item have been received for a while without this
        variable.
        """
        self._has_come = self._has_come or self.variable in batch.columns
        if self._has_come or not len(times_ns):
            return
        if self._missing_since_ns is None:
            self._missing_since_ns = int(times_ns[0])
        lasted_ns = int(times_ns[-1]) - self._missing_since_ns
        if lasted_ns >= _MISSING_NS:
            hint = did_you_mean(self.variable, batch.columns)
            raise UsageError(f"has not come in {lasted_ns / NS:.0f} s of {self.item}{hint}")

    def series(self) -> tuple[IntArray, Any]:
        """Return times and values so far."""
        if not self._times_ns:
            return np.empty(0, np.int64), np.empty(0, object)
        if len(self._times_ns) > 1:
            self._times_ns = [np.maximum.accumulate(np.concatenate(self._times_ns))]
            self._values = [_joined(self._values)]
        return self._times_ns[0], self._values[0]

    def forget_before(self, at_ns: int) -> None:
        """Drop the samples before an instant, except the last one that had a value then."""
        times_ns, values = self.series()
        end = int(np.searchsorted(times_ns, at_ns, "right"))
        known = np.flatnonzero(~_null(values[:end]))
        first = int(known[-1]) if len(known) else max(end - 1, 0)
        if first:
            self._times_ns, self._values = [times_ns[first:]], [values[first:]]


class _StatusSeries(_AddressSeries):
    """The level of a component or mode, or an output of it, as the watcher writes them."""

    def __init__(self, address: str, component: str, mode: str, output: str = "") -> None:
        super().__init__(f"{STATUS_ITEM}.level")
        self.address = address
        self._of = (component, mode)
        self._output = output

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Add the statuses of the address; an output that one does not have is unknown then."""
        components, modes = batch.columns["component"], batch.columns["mode"]
        rows = [n for n in range(len(batch)) if (components[n], modes[n]) == self._of]
        if not rows:
            return
        values = np.full(len(rows), None, object)
        if self._output:
            outputs = batch.children.get("outputs")
            by_seq = {} if outputs is None else _outputs(outputs, self._output)
            values[:] = [by_seq.get(int(seq)) for seq in batch.seq[rows]]
        else:
            values[:] = [str(batch.columns["level"][row]) for row in rows]
        self._times_ns.append(times_ns[rows])
        self._values.append(values)


def _outputs(rows: Batch, name: str) -> dict[int, Value]:
    """Return an output's values by the ``seq`` of the statuses that have it."""
    columns = rows.columns
    found = np.flatnonzero(np.asarray(columns["name"], object) == name).tolist()
    return {int(columns["parent_seq"][n]): _output(columns, n) for n in found}


def _output(columns: Mapping[str, Any], row: int) -> Value:
    kind, value = columns["type"][row], columns["value"][row]
    is_missing = value is None or value is np.ma.masked
    if kind == "string":
        return str(columns["text"][row])
    if kind == "float" and is_missing:
        return float(columns["text"][row])  # NaN and infinities, for which JSON has no number
    if kind == "null" or is_missing:
        return None
    return bool(value) if kind == "bool" else int(value) if kind == "int" else float(value)


def _series_of(address: str) -> _AddressSeries:
    output = of_monitors(address)
    return _AddressSeries(address) if output is None else _StatusSeries(address, *output)


def value_after(
    expression: Expression, batches: Iterable[Batch], known: Mapping[str, Value]
) -> Value:
    """Return the value of an expression after the last row; None where it is unknown.

    Addresses are those of ``ConditionWatcher``; names in ``known`` have the values given there.
    Raises UsageError for values of a wrong type.
    """
    samples = [_series_of(name) for name in expression.addresses() if name not in known]
    last_ns = _LONG_AGO
    for batch in batches:
        last_ns = max([last_ns, *batch.received_ns[-1:].tolist()])
        for part in batch_and_children(batch):
            times_ns = batch.received_ns[np.searchsorted(batch.seq, part.seq)]
            for one in samples:
                if one.item == part.item:
                    one.add(part, times_ns)
    series = {one.address: one.series() for one in samples}
    for name in known:
        series[name] = (np.array([_LONG_AGO], np.int64), single_value(known[name]))
    found: Value = expression.evaluate_series(
        {name: series[name] for name in expression.addresses()}, last_ns
    )
    return found


def item_of(address: str) -> str:
    """Return the item in which an address is recorded."""
    return STATUS_ITEM if of_monitors(address) is not None else address.partition(".")[0]


def addresses_of(condition: WatchedCondition) -> Iterator[str]:
    """Yield the addresses that a condition reads, each once."""
    yield from dict.fromkeys(a for e in condition.expressions() for a in e.addresses())


def address_problem(expression: Expression, *, with_monitors: bool = False) -> str:
    """Return which address cannot be one of a recorded variable; empty if all can.

    ``with_monitors``: outputs of monitors and statuses of this robot can be named, too.
    """
    for address in expression.addresses():
        if with_monitors and ":" not in address and of_monitors(address) is not None:
            continue
        item, dot, variable = address.partition(".")
        if not (dot and item and variable) or any(mark in address for mark in "/#:"):
            more = ", component/mode/output or status(component)" if with_monitors else ""
            return f"'{address}' is no recorded variable; write item.variable{more}"
    return ""


def condition_problem(expression: Expression, *, with_monitors: bool = False) -> str:
    """Return why an expression is no condition over recorded variables; empty if it is one."""
    if expression.kind not in ("condition", "any"):
        return NO_CONDITION
    return address_problem(expression, with_monitors=with_monitors)


def _null(values: Any) -> Any:
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.getmaskarray(values)
    return np.array([value is None for value in values], bool)


def _joined(columns: Sequence[Any]) -> Any:
    if all(isinstance(column, np.ma.MaskedArray) for column in columns):
        data = np.concatenate([np.ma.getdata(column) for column in columns])
        return np.ma.MaskedArray(data, np.concatenate([_null(column) for column in columns]))
    return np.concatenate([_as_objects(column) for column in columns])


def _as_objects(column: Any) -> Any:
    if not isinstance(column, np.ma.MaskedArray):
        return column
    objects = np.ma.getdata(column).astype(object)
    objects[np.ma.getmaskarray(column)] = None
    return objects
