"""What an expression means: its value at instants, over series of samples.

A variable has the value of its last sample at or before an instant (sample and hold); before the
first sample it is null. Everything else follows from this: a tree is evaluated for many instants
at once, and one instant is the case of a single one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core import expression_values as on
from amberbox.core.config import did_you_mean
from amberbox.core.expression_tree import (
    Address,
    Age,
    Arithmetic,
    Call,
    Comparison,
    Constant,
    Fault,
    Held,
    Logic,
    Negative,
    Not,
    Tree,
    Window,
    needs_history,
)
from amberbox.core.expression_values import Values
from amberbox.core.expression_windows import count, joined_times, minimum, reduce_windows
from amberbox.core.types import IntArray

_INDEX = re.compile(r"(.+)\[(\d+)\]")


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples of one variable; ``times_ns`` never decreases."""

    times_ns: IntArray
    values: Values


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """Where to evaluate: instants of time, or a range of rows of series that share their times.

    ``has_time`` is False where only current values are known.
    """

    series: Mapping[str, Series]
    times_ns: IntArray
    rows: slice | None = None
    has_time: bool = True
    looked_up: dict[str, Values] = field(default_factory=dict)
    """Values of addresses at the instants, each found once."""
    windows: dict[str, Values] = field(default_factory=dict)
    """Values of windows at the instants, likewise; by what they say."""

    def __len__(self) -> int:
        return len(self.times_ns)

    def moved(self, times_ns: IntArray) -> Instants:
        """Return other instants over the same series."""
        return Instants(self.series, times_ns)


def series_of(
    reads: Iterable[Address], columns: Mapping[str, tuple[IntArray, Any]]
) -> dict[str, Series]:
    """Look up every address that a tree reads; raise Fault for one that is not there."""
    return {address.name: _series(address, columns) for address in reads}


def evaluate(tree: Tree, where: Instants) -> Values:
    """Return the value of a tree at each instant."""
    with np.errstate(all="ignore"):
        return value_of(tree, where)


def rows_of(tree: Tree, series: Mapping[str, Series], times_ns: IntArray) -> Instants:
    """Evaluate row by row where no history is needed, else at the instants of the rows."""
    whole = None if needs_history(tree) else slice(0, len(times_ns))
    return Instants(series, times_ns, whole)


def value_of(tree: Tree, where: Instants) -> Values:
    """Return the same where numpy keeps quiet already."""
    return _VALUE[type(tree)](tree, where)


def _series(part: Address, columns: Mapping[str, tuple[IntArray, Any]]) -> Series:
    match = _INDEX.fullmatch(part.name)
    if part.name in columns:
        times_ns, column = columns[part.name]
        return _paired(times_ns, on.values_of(column, part.at), part)
    if match and match[1] in columns:
        times_ns, column = columns[match[1]]
        return _paired(times_ns, on.element_of(column, int(match[2]), part.at), part)
    known = ", ".join(sorted(columns)[:8])
    what = f"there is no value for '{part.name}'{did_you_mean(part.name, columns)}"
    raise Fault(what, part.at, f"known: {known}" if known else "")


def _paired(times_ns: IntArray, values: Values, part: Address) -> Series:
    if len(times_ns) != len(values):
        raise Fault(f"has {len(values)} values for {len(times_ns)} instants", part.at)
    return Series(times_ns, values)


def _constant(tree: Constant, where: Instants) -> Values:
    return on.constant(tree.value, len(where))


def _address(tree: Address, where: Instants) -> Values:
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


def _number(tree: Tree, where: Instants, wanted_by: str) -> Values:
    return on.as_number(value_of(tree, where), wanted_by, tree.at)


def _condition(tree: Tree, where: Instants, wanted_by: str) -> Values:
    return on.as_condition(value_of(tree, where), wanted_by, tree.at)


def _negative(tree: Negative, where: Instants) -> Values:
    inner = _number(tree.inner, where, "'-'")
    return Values(-inner.data, inner.null, "number")


def _arithmetic(tree: Arithmetic, where: Instants) -> Values:
    sign = tree.operator
    left, right = (_number(part, where, f"'{sign}'") for part in (tree.left, tree.right))
    return on.arithmetic(sign, left, right)


def _comparison(tree: Comparison, where: Instants) -> Values:
    sides = [value_of(operand, where) for operand in tree.operands]
    pairs = zip(tree.operators, sides, sides[1:], strict=False)
    return on.joined("and", [on.compare(sign, a, b, tree.at) for sign, a, b in pairs])


def _not(tree: Not, where: Instants) -> Values:
    return on.negated(_condition(tree.inner, where, "'not'"))


def _logic(tree: Logic, where: Instants) -> Values:
    word = tree.operator
    return on.joined(word, [_condition(part, where, f"'{word}'") for part in tree.operands])


def _call(tree: Call, where: Instants) -> Values:
    if tree.name == "known":
        null = value_of(tree.arguments[0], where).null
        return Values(~null, np.zeros(len(null), bool), "condition")
    return on.call(tree.name, [_number(part, where, tree.name) for part in tree.arguments])


def _age(tree: Age, where: Instants) -> Values:
    _require_time(tree, where)
    series = where.series[tree.inner.name]
    known_ns = series.times_ns[~series.values.null]
    if not len(known_ns):
        return on.constant(None, len(where))
    last = np.searchsorted(known_ns, where.times_ns, "right") - 1
    age_s = (where.times_ns - known_ns[np.maximum(last, 0)]) / 1e9
    return Values(age_s, last < 0, "number")


def _window(tree: Window, where: Instants) -> Values:
    _require_time(tree, where)
    found = where.windows.get(tree.saying)
    if found is None:
        found = where.windows[tree.saying] = _reduced(tree, where)
    return found


def _reduced(tree: Window, where: Instants) -> Values:
    if not len(where):
        return on.constant(None, 0)
    times_ns, values = _samples(tree, where)
    first_ns = where.times_ns - tree.over_ns
    if tree.name == "count":
        return count(times_ns, counted(values), first_ns, where.times_ns)
    known_ns, numbers = known_numbers(tree, times_ns, values)
    return reduce_windows(tree.name, known_ns, numbers, first_ns, where.times_ns)


def counted(values: Values) -> NDArray[np.bool_]:
    """Return which samples ``count`` counts: conditions that are true, or all that is known."""
    return ~values.null & values.data if values.kind == "condition" else ~values.null


def known_numbers(
    tree: Window, times_ns: IntArray, values: Values
) -> tuple[IntArray, NDArray[np.float64]]:
    """Return what a window is computed of: times and numbers, without what is unknown."""
    numbers = on.as_number(values, tree.name, tree.inner.at)
    if not np.count_nonzero(numbers.null):
        return times_ns, numbers.data
    known = ~numbers.null
    return times_ns[known], numbers.data[known]


def _samples(tree: Window, where: Instants) -> tuple[IntArray, Values]:
    """Evaluate the inner tree at every sample of its addresses that a window can hold."""
    since, until = where.times_ns.min() - tree.over_ns, where.times_ns.max()
    clocks = _clocks(tree.reads, where.series)
    if len(clocks) == 1 and not tree.is_nested:
        rows = slice(*(int(np.searchsorted(clocks[0], t, "right")) for t in (since, until)))
        times_ns = clocks[0][rows]
        return times_ns, value_of(tree.inner, Instants(where.series, times_ns, rows))
    times_ns = _between([(clock, 0) for clock in clocks], since, until)
    return times_ns, value_of(tree.inner, where.moved(times_ns))


def _held(tree: Held, where: Instants) -> Values:
    """True if the condition is true throughout ``[t - for, t]``, both ends included.

    The condition can only change at its breakpoints, so it is looked at there and at both ends.
    """
    _require_time(tree, where)
    if not len(where):
        return on.constant(None, 0)
    start_ns = where.times_ns - tree.for_ns
    breakpoints = [(where.series[name].times_ns, delay) for name, delay in tree.breakpoints]
    changes = _between(breakpoints, start_ns.min(), where.times_ns.max())
    grid = joined_times([changes, start_ns, where.times_ns])
    inner = _condition(tree.inner, where.moved(grid), "'for'")
    false_unknown_true = np.where(inner.null, 1, np.where(inner.data, 2, 0))
    first = np.searchsorted(grid, start_ns, "left")
    after = np.searchsorted(grid, where.times_ns, "right")
    least = minimum(false_unknown_true, first, after)
    return Values(least == 2, least == 1, "condition")


def _require_time(tree: Tree, where: Instants) -> None:
    if not where.has_time:
        raise Fault("needs the past, only current values are known here", tree.at)


def _clocks(names: Iterable[str], series: Mapping[str, Series]) -> list[IntArray]:
    """Return the different time axes of addresses."""
    found: list[IntArray] = []
    for times_ns in (series[name].times_ns for name in names):
        if not any(times_ns is other or np.array_equal(times_ns, other) for other in found):
            found.append(times_ns)
    return found


def _between(clocks: Iterable[tuple[IntArray, int]], since_ns: int, until_ns: int) -> IntArray:
    """Join instants in ``(since, until]``, each once, in order; clocks come with a delay."""
    inside = [np.zeros(0, np.int64)]
    for times_ns, delay_ns in clocks:
        first, end = times_ns.searchsorted([since_ns - delay_ns, until_ns - delay_ns], "right")
        inside.append(times_ns[first:end] + delay_ns)
    return joined_times(inside)


_VALUE: dict[type[Tree], Callable[[Any, Instants], Values]] = {
    Constant: _constant,
    Address: _address,
    Negative: _negative,
    Arithmetic: _arithmetic,
    Comparison: _comparison,
    Not: _not,
    Logic: _logic,
    Call: _call,
    Age: _age,
    Window: _window,
    Held: _held,
}
