"""Conditions over a record as it grows: tell when each of them becomes true.

Rows come in batches, edges go out in order of time. How the rows are split into batches does not
matter, and neither does how often is asked: live and replay give the same edges.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, Value
from amberbox.core.expression_tree import Fault, of_monitors
from amberbox.core.expression_values import element_of, values_of
from amberbox.core.names import identifier
from amberbox.core.types import Batch, IntArray

STATUS = identifier(reserved.STATUS)
"""The item in which the watcher writes statuses."""
TICK_NS = NS // 10
"""Conditions that depend on an age are looked at this often between samples, too."""

_TICKS = 36_000
"""So many of these instants are looked at together."""
_SILENCE_NS = 7 * 86_400 * NS
"""A longer silence has no more of them: by then it is a leap of the clock."""
_MISSING_NS = 60 * NS
"""Fields of JSON may come later; a variable that has not come by then is told."""
_LONG_AGO = -(1 << 62)


@dataclass(frozen=True, slots=True)
class Condition:
    """An expression to watch; ``asides`` are read at the instants at which it becomes true."""

    when: Expression
    asides: Mapping[str, Expression] = field(default_factory=dict)

    def expressions(self) -> Iterator[Expression]:
        """Give everything that has to be evaluated."""
        yield self.when
        yield from self.asides.values()


@dataclass(frozen=True, slots=True)
class Edge:
    """A condition has become true; ``values`` are its asides at that instant."""

    name: str
    at_ns: int
    values: Mapping[str, Value] = field(default_factory=dict)


class Conditions:
    """Watches named conditions over what is recorded and what monitors say.

    Addresses are ``item.variable``, ``component/mode/output`` and ``status(component)``.
    Times are those of the batches unless others are given; they must not decrease per item.
    While it is unknown whether a condition is true, it counts as it was known last.
    What a condition cannot be judged by (a text where a number was expected) is told in
    ``problems``, once; it then never becomes true.
    """

    def __init__(self, conditions: Mapping[str, Condition]) -> None:
        self._conditions = dict(conditions)
        self._samples = {a: _samples(a) for c in conditions.values() for a in addresses_of(c)}
        self._was_true = dict.fromkeys(conditions, False)
        self._until_ns = _LONG_AGO
        self.problems: dict[str, str] = {}

    @property
    def items(self) -> frozenset[str]:
        """Names of the items whose batches are wanted: those named, or parents of child tables."""
        found = map(item_of, self._samples)
        return frozenset(name for item in found for name in _with_parents(item))

    @property
    def tables(self) -> frozenset[str]:
        """Names of the items and child tables that are read."""
        return frozenset(samples.item for samples in self._samples.values())

    def variables(self, table: str) -> list[str]:
        """Name the variables of a table that are read."""
        found = (s.variable for s in self._samples.values() if s.item == table)
        return list(dict.fromkeys(found))

    @property
    def history_ns(self) -> int:
        """How far back rows matter to what is true now."""
        depths = (e.history_ns for c in self._conditions.values() for e in c.expressions())
        return max(depths, default=0)

    def add(self, batch: Batch, times_ns: IntArray | None = None) -> None:
        """Take the rows of a batch and of its child tables."""
        times_ns = batch.received_ns if times_ns is None else times_ns
        for samples in self._samples.values():
            if samples.item == batch.item:
                self._take(samples, batch, times_ns)
        for child in batch.children.values():
            place = np.searchsorted(batch.seq, child.seq)
            self.add(child, times_ns[place])

    def _take(self, samples: _Samples, batch: Batch, times_ns: IntArray) -> None:
        try:
            samples.add(batch, times_ns)
        except (Fault, UsageError) as error:
            self.problems.setdefault(samples.address, f"'{samples.address}' {error}")

    @property
    def true(self) -> list[str]:
        """Name the conditions that were true when they were last known."""
        return [name for name, is_true in self._was_true.items() if is_true]

    def resume(self, true: Iterable[str], at_ns: int = _LONG_AGO) -> None:
        """Go on where somebody else stopped: these were true, edges up to ``at_ns`` are told."""
        self._was_true |= dict.fromkeys(set(true) & self._was_true.keys(), True)
        self._until_ns = at_ns

    def begin_anew(self) -> None:
        """Forget all rows, as at the start of a run, but not what was true."""
        self._samples = {address: _samples(address) for address in self._samples}
        self._until_ns = _LONG_AGO

    def start_at(self, at_ns: int) -> None:
        """Take what is true at an instant for known: no edge up to there is told."""
        self.edges(at_ns)

    def edges(self, until_ns: int) -> list[Edge]:
        """Return what became true since the last call and up to ``until_ns``, in order of time.

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

    def _edges_of(self, name: str, series: Any, until_ns: int) -> list[Edge]:
        condition = self._conditions[name]
        try:
            at_ns = self._rising(name, condition.when, series, until_ns)
        except AmberboxError as error:
            self.problems.setdefault(name, error.what)
            return []
        return [Edge(name, t, self._asides(name, condition, series, t)) for t in at_ns]

    def _rising(self, name: str, when: Expression, series: Any, until_ns: int) -> list[int]:
        """Return when the expression became true after the last instant looked at."""
        rising: list[int] = []
        for instants in instants_of(when, series, self._until_ns, until_ns):
            rising += self._rising_at(name, when, series, instants)
        return rising

    def _rising_at(self, name: str, when: Expression, series: Any, instants: IntArray) -> list[int]:
        if not len(instants):
            return []
        values = when.evaluate_series(series, instants)
        if np.ma.getdata(values).dtype != bool and not _null(values).all():
            raise UsageError("is no condition: compare it with something, such as: x > 0")
        true = _known_last(values, self._was_true[name])
        before = np.concatenate([[self._was_true[name]], true[:-1]])
        self._was_true[name] = bool(true[-1])
        rising: list[int] = instants[true & ~before].tolist()
        return rising

    def _asides(self, name: str, condition: Condition, series: Any, at_ns: int) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for aside, expression in condition.asides.items():
            try:
                found[aside] = expression.evaluate_series(series, at_ns)
            except AmberboxError as error:
                self.problems.setdefault(f"{name}: {aside}", error.what)
                found[aside] = None
        return found


class _Samples:
    """The samples of one address that still matter."""

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
        """Take the values of a batch; a variable that it does not have is unknown there."""
        column = batch.columns.get(self.variable, np.full(len(times_ns), None, object))
        index = self._index
        values = values_of(column, 0) if index is None else element_of(column, index, 0)
        self._times_ns.append(times_ns)
        self._values.append(values.column())
        self._miss(batch, times_ns)

    def _miss(self, batch: Batch, times_ns: IntArray) -> None:
        """Raise UsageError if the item has come for a while, and never with this variable."""
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
        """Drop what came before an instant, but for the last sample that had a value then."""
        times_ns, values = self.series()
        end = int(np.searchsorted(times_ns, at_ns, "right"))
        known = np.flatnonzero(~_null(values[:end]))
        first = int(known[-1]) if len(known) else max(end - 1, 0)
        if first:
            self._times_ns, self._values = [times_ns[first:]], [values[first:]]


class _Said(_Samples):
    """The level of a component or mode, or an output of it, as the watcher writes them."""

    def __init__(self, address: str, component: str, mode: str, output: str = "") -> None:
        super().__init__(f"{STATUS}.level")
        self.address = address
        self._of = (component, mode)
        self._output = output

    def add(self, batch: Batch, times_ns: IntArray) -> None:
        """Take the statuses that are meant; an output that one does not have is unknown then."""
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


def _samples(address: str) -> _Samples:
    said = of_monitors(address)
    return _Samples(address) if said is None else _Said(address, *said)


def item_of(address: str) -> str:
    """Return the item in which an address is recorded."""
    return STATUS if of_monitors(address) is not None else address.partition(".")[0]


def addresses_of(condition: Condition) -> Iterator[str]:
    """Name what a condition reads, each address once."""
    yield from dict.fromkeys(a for e in condition.expressions() for a in e.addresses())


def address_problem(expression: Expression, *, with_monitors: bool = False) -> str:
    """Say which address cannot be one of a recorded variable; empty if all can.

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
    """Say why an expression cannot tell when something is the case; empty if it can."""
    if expression.kind not in ("condition", "any"):
        return "is no condition: compare it with something, such as: x > 0"
    return address_problem(expression, with_monitors=with_monitors)


def instants_of(
    expression: Expression, series: Any, since_ns: int, until_ns: int
) -> Iterator[IntArray]:
    """Give the instants in ``(since, until]`` at which the value may change, in order."""
    times = [series[address][0] for address in expression.addresses()]
    found = [t + delay for t in times for delay in expression.delays_ns()]
    inside = [t[(t > since_ns) & (t <= until_ns)] for t in found]
    changes: IntArray = np.unique(np.concatenate([np.zeros(0, np.int64), *inside]))
    reached_ns = since_ns
    for ticks in _ticks(times, since_ns, until_ns) if expression.reads_age else ():
        between = changes[(changes > reached_ns) & (changes <= ticks[-1])]
        yield np.union1d(between, ticks)
        reached_ns = int(ticks[-1])
    yield changes[changes > reached_ns]


def _ticks(times: Sequence[IntArray], since_ns: int, until_ns: int) -> Iterator[IntArray]:
    """Give regular instants from the first sample on, an hour of them at a time."""
    heard = np.unique(np.concatenate(times))
    groups = np.split(heard, np.flatnonzero(np.diff(heard) > _SILENCE_NS) + 1)
    for group in groups if len(heard) else ():
        first = max(int(group[0]), since_ns) // TICK_NS + 1
        end = min(int(group[-1]) + _SILENCE_NS, until_ns) // TICK_NS + 1
        for start in range(first, end, _TICKS):
            yield np.arange(start, min(start + _TICKS, end), dtype=np.int64) * TICK_NS


def _known_last(values: Any, before: bool) -> Any:
    """Say what was last known to be the case: unknown is not false."""
    null = _null(values)
    data = np.zeros(len(null), bool)
    data[~null] = np.ma.getdata(values)[~null]
    last = np.maximum.accumulate(np.where(null, -1, np.arange(len(null))))
    return np.where(last < 0, before, data[last])


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


def _with_parents(item: str) -> Iterator[str]:
    """Name an item and the items that it may be a child table of."""
    yield item
    while "__" in item:
        item = item.rpartition("__")[0]
        yield item
