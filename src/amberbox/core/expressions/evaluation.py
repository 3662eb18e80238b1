"""Evaluate expressions: over series of samples for many instants, or at one instant live.

A variable has the value of its last sample at or before an instant (sample and hold); before the
first sample it is null. For many instants a tree is evaluated with arrays. For one instant it
becomes functions of plain Python values, once for each combination of the kinds of its variables,
so that a value of the wrong kind is found before anything is computed; both give the same bits.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import did_you_mean
from amberbox.core.expressions import values as on
from amberbox.core.expressions.tree import (
    AddressNode,
    AgeNode,
    ArithmeticNode,
    CallNode,
    ComparisonNode,
    ConstantNode,
    ExpressionFault,
    ExpressionNode,
    HeldNode,
    Kind,
    LogicNode,
    NegativeNode,
    NotNode,
    WindowNode,
    kind_of_value,
    needs_history,
)
from amberbox.core.expressions.values import (
    Values,
    count,
    joined_times,
    minimum,
    reduce_whole,
    reduce_windows,
)
from amberbox.core.types import IntArray

_INDEX = re.compile(r"(.+)\[(\d+)\]")


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples of one variable; ``times_ns`` never decreases."""

    times_ns: IntArray
    values: Values


@dataclass(frozen=True, slots=True, eq=False)
class WindowCache:
    """What windows of expressions over the same samples share at the same instants."""

    results: dict[str, Any] = field(default_factory=dict)
    """Values of windows, by their text."""
    looked_up: dict[int, dict[str, Values]] = field(default_factory=dict)
    """Samples in windows of a length, by address."""
    computed: dict[int, dict[str, Values]] = field(default_factory=dict)
    """What is computed of these, by its text."""

    def inside(
        self, over_ns: int, series: Mapping[str, Series], times_ns: IntArray, rows: slice
    ) -> Instants:
        """Return the samples in windows of a length, at the times of their addresses."""
        looked_up = self.looked_up.setdefault(over_ns, {})
        computed = self.computed.setdefault(over_ns, {})
        return Instants(series, times_ns, rows, looked_up=looked_up, computed=computed)


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """Where to evaluate: instants of time, or a range of rows of series that share their times."""

    series: Mapping[str, Series]
    times_ns: IntArray
    rows: slice | None = None
    looked_up: dict[str, Values] = field(default_factory=dict)
    """Values of addresses at the instants, each found once."""
    computed: dict[str, Values] = field(default_factory=dict)
    """Results of arithmetic at the instants, likewise, by their text."""
    windows: WindowCache = field(default_factory=WindowCache)

    def __len__(self) -> int:
        return len(self.times_ns)

    def moved(self, times_ns: IntArray) -> Instants:
        """Return other instants over the same series."""
        return Instants(self.series, times_ns)


def series_of(
    reads: Iterable[AddressNode], columns: Mapping[str, tuple[IntArray, Any]]
) -> dict[str, Series]:
    """Look up every address that a tree reads; raise Fault for a missing one."""
    return {address.name: _series(address, columns) for address in reads}


def evaluate(tree: ExpressionNode, where: Instants) -> Values:
    """Return the value of a tree at each instant."""
    with np.errstate(all="ignore"):
        return value_of(tree, where)


def rows_of(tree: ExpressionNode, series: Mapping[str, Series], times_ns: IntArray) -> Instants:
    """Evaluate row by row where no history is needed, else at the instants of the rows."""
    whole = None if needs_history(tree) else slice(0, len(times_ns))
    return Instants(series, times_ns, whole)


def value_of(tree: ExpressionNode, where: Instants) -> Values:
    """Return the same as ``evaluate``; the caller has silenced numpy's warnings."""
    return _NODES[type(tree)][0](tree, where)


def _series(part: AddressNode, columns: Mapping[str, tuple[IntArray, Any]]) -> Series:
    match = _INDEX.fullmatch(part.name)
    if part.name in columns:
        times_ns, column = columns[part.name]
        return _paired(times_ns, on.values_of(column, part.at), part)
    if match and match[1] in columns:
        times_ns, column = columns[match[1]]
        return _paired(times_ns, on.element_of(column, int(match[2]), part.at), part)
    known = ", ".join(sorted(columns)[:8])
    what = f"there is no value for '{part.name}'{did_you_mean(part.name, columns)}"
    raise ExpressionFault(what, part.at, f"known: {known}" if known else "")


def _paired(times_ns: IntArray, values: Values, part: AddressNode) -> Series:
    if len(times_ns) != len(values):
        raise ExpressionFault(f"has {len(values)} values for {len(times_ns)} instants", part.at)
    return Series(times_ns, values)


def _constant_column(tree: ConstantNode, where: Instants) -> Values:
    return on.constant(tree.value, len(where))


def _address_column(tree: AddressNode, where: Instants) -> Values:
    found = where.looked_up.get(tree.name)
    if found is None:
        found = where.looked_up[tree.name] = _held_values(where.series[tree.name], where)
    return found


def _held_values(series: Series, where: Instants) -> Values:
    if where.rows is not None:
        return series.values.at(where.rows)
    if not len(series.times_ns):
        return on.constant(None, len(where))
    last = series.times_ns.searchsorted(where.times_ns, "right") - 1
    if not len(last) or last.min() >= 0:
        return series.values.at(last)
    values = series.values.at(np.maximum(last, 0))
    return Values(values.data, values.null | (last < 0), values.kind)


def _number_column(tree: ExpressionNode, where: Instants, wanted_by: str) -> Values:
    return on.as_number(value_of(tree, where), wanted_by, tree.at)


def _condition_column(tree: ExpressionNode, where: Instants, wanted_by: str) -> Values:
    return on.as_condition(value_of(tree, where), wanted_by, tree.at)


def _negative_column(tree: NegativeNode, where: Instants) -> Values:
    inner = _number_column(tree.inner, where, "'-'")
    return Values(-inner.data, inner.null, "number")


def _arithmetic_column(tree: ArithmeticNode, where: Instants) -> Values:
    found = where.computed.get(tree.text)
    if found is None:
        by = f"'{tree.operator}'"
        sides = [_number_column(part, where, by) for part in (tree.left, tree.right)]
        found = where.computed[tree.text] = on.arithmetic(tree.operator, *sides)
    return found


def _comparison_column(tree: ComparisonNode, where: Instants) -> Values:
    sides = [value_of(operand, where) for operand in tree.operands]
    pairs = zip(tree.operators, sides, sides[1:], strict=False)
    return on.joined("and", [on.compare(sign, a, b, tree.at) for sign, a, b in pairs])


def _not_column(tree: NotNode, where: Instants) -> Values:
    return on.negated(_condition_column(tree.inner, where, "'not'"))


def _logic_column(tree: LogicNode, where: Instants) -> Values:
    word = tree.operator
    return on.joined(word, [_condition_column(part, where, f"'{word}'") for part in tree.operands])


def _call_column(tree: CallNode, where: Instants) -> Values:
    if tree.name == "known":
        null = value_of(tree.arguments[0], where).null
        return Values(~null, np.zeros(len(null), bool), "condition")
    return on.call(tree.name, [_number_column(part, where, tree.name) for part in tree.arguments])


def _age_column(tree: AgeNode, where: Instants) -> Values:
    series = where.series[tree.inner.name]
    known_ns = series.times_ns[~series.values.null]
    if not len(known_ns):
        return on.constant(None, len(where))
    last = np.searchsorted(known_ns, where.times_ns, "right") - 1
    age_s = (where.times_ns - known_ns[np.maximum(last, 0)]) / 1e9
    return Values(age_s, last < 0, "number")


def _window_column(tree: WindowNode, where: Instants) -> Values:
    found: Values | None = where.windows.results.get(tree.text)
    if found is None:
        found = where.windows.results[tree.text] = _reduced(tree, where)
    return found


def _reduced(tree: WindowNode, where: Instants) -> Values:
    if not len(where):
        return on.constant(None, 0)
    times_ns, values = _samples(tree, where)
    first_ns = where.times_ns - tree.over_ns
    if tree.name == "count":
        return count(times_ns, counted(values), first_ns, where.times_ns)
    known_ns, numbers = known_numbers(tree, times_ns, values)
    return reduce_windows(tree.name, known_ns, numbers, first_ns, where.times_ns)


def counted(values: Values) -> NDArray[np.bool_]:
    """Return which samples ``count`` counts: conditions that are true, or all known values."""
    return ~values.null & values.data if values.kind == "condition" else ~values.null


def known_numbers(
    tree: WindowNode, times_ns: IntArray, values: Values
) -> tuple[IntArray, NDArray[np.float64]]:
    """Return the samples of a window: times and numbers, without unknown ones."""
    numbers = on.as_number(values, tree.name, tree.inner.at)
    if not np.count_nonzero(numbers.null):
        return times_ns, numbers.data
    known = ~numbers.null
    return times_ns[known], numbers.data[known]


def _samples(tree: WindowNode, where: Instants) -> tuple[IntArray, Values]:
    """Evaluate the inner tree at every sample of its addresses that a window can hold."""
    since, until = where.times_ns.min() - tree.over_ns, where.times_ns.max()
    clocks = _clocks(tree.reads, where.series)
    if len(clocks) == 1 and not tree.is_nested:
        rows = slice(*(int(np.searchsorted(clocks[0], t, "right")) for t in (since, until)))
        times_ns = clocks[0][rows]
        inside = where.windows.inside(tree.over_ns, where.series, times_ns, rows)
        return times_ns, value_of(tree.inner, inside)
    times_ns = _between([(clock, 0) for clock in clocks], since, until)
    return times_ns, value_of(tree.inner, where.moved(times_ns))


def _held_column(tree: HeldNode, where: Instants) -> Values:
    """Return whether the condition is true throughout ``[t - for, t]``, both ends included.

    The condition can only change at its breakpoints, so it is evaluated there and at both ends.
    """
    if not len(where):
        return on.constant(None, 0)
    start_ns = where.times_ns - tree.for_ns
    breakpoints = [(where.series[name].times_ns, delay) for name, delay in tree.breakpoints]
    changes = _between(breakpoints, start_ns.min(), where.times_ns.max())
    grid = joined_times([changes, start_ns, where.times_ns])
    inner = _condition_column(tree.inner, where.moved(grid), "'for'")
    false_unknown_true = np.where(inner.null, 1, np.where(inner.data, 2, 0))
    first = np.searchsorted(grid, start_ns, "left")
    after = np.searchsorted(grid, where.times_ns, "right")
    least = minimum(false_unknown_true, first, after)
    return Values(least == 2, least == 1, "condition")


def _clocks(names: Iterable[str], series: Mapping[str, Series]) -> list[IntArray]:
    """Return the different time axes of addresses."""
    found: list[IntArray] = []
    for times_ns in (series[name].times_ns for name in names):
        if not any(times_ns is other or np.array_equal(times_ns, other) for other in found):
            found.append(times_ns)
    return found


def _between(clocks: Iterable[tuple[IntArray, int]], since_ns: int, until_ns: int) -> IntArray:
    """Join instants in ``(since, until]``, each once, in order; each clock has a delay."""
    inside = [np.zeros(0, np.int64)]
    for times_ns, delay_ns in clocks:
        first, end = times_ns.searchsorted([since_ns - delay_ns, until_ns - delay_ns], "right")
        inside.append(times_ns[first:end] + delay_ns)
    return joined_times(inside)


Kinds: TypeAlias = Mapping[str, Kind]


class Track(NamedTuple):
    """Samples of one variable, each held until the next; ``times_ns`` never decreases."""

    times_ns: IntArray
    data: on.Array
    null: on.Mask | None
    kind: Kind | None
    """None for objects, whose values have kinds of their own."""
    at: int
    """The place of its address in the text."""

    def part(self, rows: slice) -> on.Values:
        """Return some of the values as those of many instants."""
        null = None if self.null is None else self.null[rows]
        return on.values_of_array(self.data[rows], null, self.kind, self.at)

    def series(self) -> Series:
        """Return all of them as those of many instants."""
        return Series(self.times_ns, self.part(slice(None)))

    def value(self, at_ns: int) -> tuple[Any, Kind]:
        """Return the last value by an instant as plain Python, None for null, and its kind."""
        last = int(self.times_ns.searchsorted(at_ns, "right")) - 1
        unknown = last < 0 or (self.null is not None and self.null[last])
        value = None if unknown else self.data.item(last)
        if self.kind is None and value is not None:
            return on.plain(value, self.at)
        return value, self.kind or "null"


class InstantView:
    """The input of an expression at one instant: the time, and tracks by address."""

    def __init__(
        self,
        at_ns: int,
        tracks: Mapping[str, Track],
        windows: WindowCache | None = None,
    ) -> None:
        self.at_ns = at_ns
        self.tracks = tracks
        self.windows = WindowCache() if windows is None else windows
        self.values: dict[str, Any] = {}

    @cached_property
    def whole(self) -> Instants:
        """The instant as one of many, over all samples."""
        series = {name: track.series() for name, track in self.tracks.items()}
        return Instants(series, np.array([self.at_ns], np.int64))

    def take(self, names: Sequence[str]) -> tuple[Kind, ...]:
        """Read the present values of variables; return their kinds."""
        found = [self.tracks[name].value(self.at_ns) for name in names]
        self.values = {name: value for name, (value, _) in zip(names, found, strict=True)}
        return tuple([kind for _, kind in found])


# value of a node at an instant as plain Python, None for null
At: TypeAlias = Callable[[InstantView], Any]


def at_instant(tree: ExpressionNode, kinds: Kinds) -> At:
    """Return the function that a tree is; raise Fault where a variable's kind does not fit."""
    return _built(tree, kinds)[0]


def _number_at(tree: ExpressionNode, kinds: Kinds, wanted_by: str) -> At:
    """Return a part as a float."""
    at, kind = _built(tree, kinds)
    on.require_number(kind, wanted_by, tree.at)
    if isinstance(tree, ConstantNode) and tree.value is not None:
        number = float(tree.value)
        return lambda view: number

    def as_float(view: InstantView) -> float | None:
        value = at(view)
        return None if value is None else float(value)

    return as_float


def _condition_at(tree: ExpressionNode, kinds: Kinds, wanted_by: str) -> At:
    at, kind = _built(tree, kinds)
    on.require_condition(kind, wanted_by, tree.at)
    return at


def _constant_at(tree: ConstantNode, kinds: Kinds) -> tuple[At, Kind]:
    value = tree.value
    return lambda view: value, kind_of_value(value)


def _address_at(tree: AddressNode, kinds: Kinds) -> tuple[At, Kind]:
    name = tree.name
    return lambda view: view.values[name], kinds[name]


def _negative_at(tree: NegativeNode, kinds: Kinds) -> tuple[At, Kind]:
    return _of_known(operator.neg, _number_at(tree.inner, kinds, "'-'")), "number"


def _arithmetic_at(tree: ArithmeticNode, kinds: Kinds) -> tuple[At, Kind]:
    sign = tree.operator
    sides = [_number_at(part, kinds, f"'{sign}'") for part in (tree.left, tree.right)]
    return _of_known(on.ARITHMETIC[sign][1], *sides), "number"


def _comparison_at(tree: ComparisonNode, kinds: Kinds) -> tuple[At, Kind]:
    sides = [_built(operand, kinds) for operand in tree.operands]
    pairs = [
        _pair(sign, left, right, tree.at)
        for sign, left, right in zip(tree.operators, sides, sides[1:], strict=False)
    ]
    return (pairs[0] if len(pairs) == 1 else _joined(False, pairs)), "condition"


def _pair(sign: str, left: tuple[At, Kind], right: tuple[At, Kind], at: int) -> At:
    """Compare as ``values.compare`` does: whole numbers exactly, others as floats."""
    on.require_comparable(sign, left[1], right[1], at)
    compare = on.COMPARE[sign]

    def compared(a: Any, b: Any) -> bool:
        mixed = type(a) is not type(b) and not isinstance(a, str)
        return bool(compare(float(a), float(b)) if mixed else compare(a, b))

    return _of_known(compared, left[0], right[0])


def _not_at(tree: NotNode, kinds: Kinds) -> tuple[At, Kind]:
    return _of_known(operator.not_, _condition_at(tree.inner, kinds, "'not'")), "condition"


def _logic_at(tree: LogicNode, kinds: Kinds) -> tuple[At, Kind]:
    word = tree.operator
    parts = [_condition_at(part, kinds, f"'{word}'") for part in tree.operands]
    return _joined(word == "or", parts), "condition"


def _joined(decisive: bool, parts: Sequence[At]) -> At:
    def joined(view: InstantView) -> bool | None:
        found: bool | None = not decisive
        for part in parts:
            value = part(view)
            if value == decisive:
                return decisive
            if value is None:
                found = None
        return found

    return joined


def _call_at(tree: CallNode, kinds: Kinds) -> tuple[At, Kind]:
    if tree.name == "known":
        inner, _ = _built(tree.arguments[0], kinds)
        return lambda view: inner(view) is not None, "condition"
    arguments = [_number_at(part, kinds, tree.name) for part in tree.arguments]
    kind: Kind = "condition" if tree.name == "bit" else "number"
    return _of_known(on.FUNCTIONS[tree.name][1], *arguments), kind


def _of_known(function: Callable[..., Any], *parts: At) -> At:
    """Apply a function where all parts are known; it may return None itself."""
    if len(parts) == 1:
        (only,) = parts

        def of_one(view: InstantView) -> Any:
            value = only(view)
            return None if value is None else function(value)

        return of_one

    def of_all(view: InstantView) -> Any:
        values = []
        for part in parts:
            value = part(view)
            if value is None:
                return None
            values.append(value)
        return function(*values)

    return of_all


def _age_at(tree: AgeNode, kinds: Kinds) -> tuple[At, Kind]:
    def age_s(view: InstantView) -> float | None:
        times_ns, data, null, kind, _ = view.tracks[tree.inner.name]
        last = int(times_ns.searchsorted(view.at_ns, "right")) - 1
        if null is None and kind is None:
            null = np.array([value is None for value in data[: last + 1]], bool)
        while last >= 0 and null is not None and null[last]:
            last -= 1
        return (view.at_ns - int(times_ns[last])) / 1e9 if last >= 0 else None

    return age_s, "number"


def _window_at(tree: WindowNode, kinds: Kinds) -> tuple[At, Kind]:
    def window(view: InstantView) -> Any:
        known = view.windows.results
        if tree.text not in known:
            known[tree.text] = worked_out(view)
        return known[tree.text]

    def worked_out(view: InstantView) -> Any:
        clock = None if tree.is_nested else _one_clock([view.tracks[name] for name in tree.reads])
        if clock is None:
            return value_of(tree, view.whole).scalar(0)
        first = int(clock.searchsorted(view.at_ns - tree.over_ns, "right"))
        rows = slice(first, int(clock.searchsorted(view.at_ns, "right")))
        times_ns = clock[rows]
        inside = view.windows.inside(tree.over_ns, {}, times_ns, rows)
        for name in tree.reads:
            if name not in inside.looked_up:
                inside.looked_up[name] = view.tracks[name].part(rows)
        values = value_of(tree.inner, inside)
        if tree.name == "count":
            return int(np.count_nonzero(counted(values)))
        return reduce_whole(tree.name, *known_numbers(tree, times_ns, values))

    return window, "number"


def _one_clock(tracks: Sequence[Track]) -> IntArray | None:
    """Return the times of tracks if they share them."""
    if not tracks:
        return None
    clock = tracks[0].times_ns
    content = clock.tobytes() if len(tracks) > 1 else b""
    others = (track.times_ns for track in tracks[1:])
    same = all(len(one) == len(clock) and one.tobytes() == content for one in others)
    return clock if same else None


def _held_at(tree: HeldNode, kinds: Kinds) -> tuple[At, Kind]:
    now = _condition_at(tree.inner, kinds, "'for'")

    def held(view: InstantView) -> Any:
        return False if now(view) is False else value_of(tree, view.whole).scalar(0)

    return held, "condition"


def _built(tree: ExpressionNode, kinds: Kinds) -> tuple[At, Kind]:
    return _NODES[type(tree)][1](tree, kinds)


_NODES: Mapping[
    type[ExpressionNode],
    tuple[Callable[[Any, Instants], Values], Callable[[Any, Kinds], tuple[At, Kind]]],
] = {
    ConstantNode: (_constant_column, _constant_at),
    AddressNode: (_address_column, _address_at),
    NegativeNode: (_negative_column, _negative_at),
    ArithmeticNode: (_arithmetic_column, _arithmetic_at),
    ComparisonNode: (_comparison_column, _comparison_at),
    NotNode: (_not_column, _not_at),
    LogicNode: (_logic_column, _logic_at),
    CallNode: (_call_column, _call_at),
    AgeNode: (_age_column, _age_at),
    WindowNode: (_window_column, _window_at),
    HeldNode: (_held_column, _held_at),
}
