"""Several inputs of a mode looked at together: at common instants, by name, against each other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.expression import Expression
from amberbox.core.expression_windows import joined_times
from amberbox.core.mode import Input
from amberbox.core.samples import Now, is_one
from amberbox.core.types import IntArray


@cache
def place_name(place: int) -> str:
    """Return what expressions of a mode call its inputs: ``input_1`` is the first."""
    return f"input_{place + 1}"


@cache
def reads_of(*expressions: Expression | None) -> tuple[str, ...]:
    """Return the addresses that expressions read, each once, without inputs of the mapping."""
    names = [name for one in expressions if one is not None for name in one.addresses()]
    return tuple(dict.fromkeys(name for name in names if not _is_place(name)))


def by_name(inputs: Sequence[Input], reads: Sequence[str]) -> dict[str, Input]:
    """Name what a mode is given: inputs of the mapping by their place, then what it reads."""
    own = len(inputs) - len(reads)
    names = [*(place_name(place) for place in range(own)), *reads]
    return dict(zip(names, inputs, strict=True))


def value_of(expression: Expression, inputs: Mapping[str, Input], now: Now) -> Any:
    """Return the value of an expression; NaN where it is unknown, bools as 0 and 1."""
    samples = {name: inputs[name].samples for name in expression.addresses()}
    return expression.numbers(samples, now)


def sample_times(inputs: Iterable[Input], now: Now, seconds: float) -> IntArray:
    """Return when any of the inputs changed in the windows before ``now``, and right before."""
    first_ns, until = (now, now) if is_one(now) else (int(np.min(now)), int(np.max(now)))
    since = first_ns - round(seconds * NS)
    parts = {}
    for one in inputs:
        times_ns = one.samples.times_ns
        first, end = (int(times_ns.searchsorted(t, "right")) for t in (since, until))
        part = times_ns[max(first - 1, 0) : end]
        parts[part.tobytes()] = part  # variables of one message share their times
    return joined_times(list(parts.values()))


def numbers_at(one: Input, now: Now | IntArray) -> Any:
    """Return the value as a number at each instant; NaN where it is unknown or infinite."""
    samples = one.samples
    if not len(samples):
        return np.full(np.shape(now), np.nan)[()]
    last, null = samples.last(now), samples.null
    if is_one(now):
        known = last >= 0 and (null is None or not null[last])
        return finite(numbers(samples.values[last])[()]) if known else np.float64(np.nan)
    column = numbers(samples.values[last])
    known = (last >= 0) & np.isfinite(column)
    return np.where(known if null is None else known & ~null[last], column, np.nan)


def finite(values: Any) -> Any:
    """Return numbers that are finite, NaN in place of others."""
    if isinstance(values, float):  # np.where costs more than all the rest
        return values if isfinite(values) else np.float64(np.nan)
    return np.where(np.isfinite(values), values, np.nan)


def numbers(values: Any) -> NDArray[np.float64]:
    """Return values as numbers; texts and the like are NaN."""
    column = np.asarray(values, object if isinstance(values, str) else None)
    if column.dtype != object:
        return column.astype(np.float64)
    plain = [v if isinstance(v, int | float | np.number) else np.nan for v in column.flat]
    return np.array(plain, np.float64).reshape(column.shape)


def middles(values: NDArray[np.float64]) -> tuple[Any, Any]:
    """Return the two middle numbers over the first axis, which are one where it is odd.

    What is not finite does not count; where nothing else is, the middle is NaN.
    """
    if not len(values):
        nobody = np.full(values.shape[1:], np.nan)
        return nobody, nobody
    if np.isfinite(values).all():
        ordered = np.sort(values, axis=0)
        return ordered[(len(values) - 1) // 2], ordered[len(values) // 2]
    ordered = np.sort(np.where(np.isfinite(values), values, np.nan), axis=0)
    count = np.isfinite(ordered).sum(axis=0)[None]
    places = (np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1))
    low, high = (np.take_along_axis(ordered, place, 0)[0] for place in places)
    return low, high


def medians(times_ns: IntArray, rows: NDArray[np.float64], now: Now, seconds: float) -> Any:
    """Return the median of each row over the ``seconds`` before each instant.

    ``rows`` have a value for each time. NaN does not count; where a window is empty the last
    value before it does, and without any it is NaN. The result has the shape of ``now`` for each
    row.
    """
    until = np.atleast_1d(np.asarray(now, np.int64))
    ends = times_ns.searchsorted(until, "right")
    starts = np.minimum(times_ns.searchsorted(until - round(seconds * NS), "right"), ends - 1)
    found = np.full((len(until), len(rows)), np.nan)
    for place, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        if end:
            found[place] = _median(rows[:, start:end])
    return found.T.reshape(len(rows), *np.shape(now))


def _median(rows: NDArray[np.float64]) -> Any:
    """Return the median of each row, which has one column at least; infinity counts, NaN not."""
    ordered = np.sort(rows, axis=1)
    if not np.isnan(ordered[:, -1]).any():
        low, high = ordered[:, (rows.shape[1] - 1) // 2], ordered[:, rows.shape[1] // 2]
        return np.where(low == high, low, (low + high) / 2)
    count = np.count_nonzero(~np.isnan(ordered), axis=1)
    which = np.arange(len(rows))
    low = ordered[which, (count - 1) // 2]
    high = ordered[which, np.minimum(count // 2, rows.shape[1] - 1)]
    return np.where(low == high, low, (low + high) / 2)


def worst_of(values: NDArray[np.float64], limit: float) -> Any:
    """Return the greatest number; NaN where something is unknown and all the rest within limits."""
    greatest = np.fmax.reduce(values)
    unknown = np.isnan(values).any(axis=0) & (greatest <= limit)
    return np.where(unknown, np.nan, greatest)[()]


def _is_place(name: str) -> bool:
    return name.startswith("input_") and name.removeprefix("input_").isdigit()
