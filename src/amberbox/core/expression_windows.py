"""Functions of the samples in a sliding window of time, for many windows at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.expression_values import Values
from amberbox.core.types import IntArray

Floats: TypeAlias = NDArray[np.float64]

_MOST_AT_ONCE = 1 << 21  # samples gathered for ``std``, about 50 MB


def count(times_ns: IntArray, flags: NDArray[np.bool_], after: IntArray, until: IntArray) -> Values:
    """Count the flags set in each window ``(after, until]``."""
    total = np.concatenate([[0], np.cumsum(flags)])
    first, last = _bounds(times_ns, after, until)
    return Values(total[last] - total[first], np.zeros(len(after), bool), "number")


def reduce_windows(
    name: str, times_ns: IntArray, samples: Floats, after: IntArray, until: IntArray
) -> Values:
    """Apply ``min max mean std rate`` to the samples of each window; null where there are none."""
    first, last = _bounds(times_ns, after, until)
    if name == "rate":
        return _rate(times_ns, samples, first, last)
    null = last <= first
    data = np.zeros(len(first))
    data[~null] = _REDUCE[name](samples, first[~null], last[~null])
    return Values(data, null, "number")


def reduce_whole(name: str, times_ns: IntArray, samples: Floats) -> float | None:
    """Apply it to all samples as to one window; None where there are too few."""
    ends = np.array([0]), np.array([len(samples)])
    if name == "rate":
        rate = _rate(times_ns, samples, *ends)
        return None if rate.null[0] else float(rate.data[0])
    return float(_REDUCE[name](samples, *ends)[0]) if len(samples) else None


def joined_times(parts: Sequence[IntArray]) -> IntArray:
    """Join times, each once, in order; times that are in order already cost little."""
    joined = np.sort(np.concatenate(parts), kind="stable")
    is_new = np.ones(len(joined), bool)
    np.not_equal(joined[1:], joined[:-1], out=is_new[1:])
    return joined[is_new]


def minimum(values: NDArray[Any], first: IntArray, last: IntArray) -> NDArray[Any]:
    """Return the least of ``values[first:last]`` for each pair, none of them empty."""
    return _segments(np.minimum, values, first, last)


def _bounds(times_ns: IntArray, after: IntArray, until: IntArray) -> tuple[IntArray, IntArray]:
    first = np.searchsorted(times_ns, after, "right")
    return first, np.searchsorted(times_ns, until, "right")


def _segments(
    function: np.ufunc, values: NDArray[Any], first: IntArray, last: IntArray
) -> NDArray[Any]:
    """Reduce overlapping segments; the value added at the end lets ``last`` be the length."""
    if not len(first):
        return values[:0]
    if len(first) == 1:
        only: NDArray[Any] = function.reduceat(values[first[0] : last[0]], [0])
        return only
    padded = np.append(values, values[-1:])
    pairs = np.stack([first, last], axis=1).ravel()
    reduced: NDArray[Any] = function.reduceat(padded, pairs)[::2]
    return reduced


def _mean(samples: Floats, first: IntArray, last: IntArray) -> Floats:
    means: Floats = _segments(np.add, samples, first, last) / (last - first)
    return means


def _std(samples: Floats, first: IntArray, last: IntArray) -> Floats:
    """Population standard deviation in two passes, which keeps it exact for large offsets."""
    lengths = last - first
    if len(first) > 1 and lengths.sum() > _MOST_AT_ONCE:
        half = len(first) // 2
        halves = ((first[:half], last[:half]), (first[half:], last[half:]))
        return np.concatenate([_std(samples, *part) for part in halves])
    ends = np.cumsum(lengths)
    rows = np.arange(lengths.sum()) + np.repeat(first - (ends - lengths), lengths)
    squares = (samples[rows] - np.repeat(_mean(samples, first, last), lengths)) ** 2
    deviations: Floats = np.sqrt(_segments(np.add, squares, ends - lengths, ends) / lengths)
    return deviations


def _rate(times_ns: IntArray, samples: Floats, first: IntArray, last: IntArray) -> Values:
    """Change per second between the first and the last sample of each window."""
    data = np.zeros(len(first))
    long = last - first >= 2
    a, b = first[long], last[long] - 1
    elapsed_s = (times_ns[b] - times_ns[a]) / 1e9
    data[long] = (samples[b] - samples[a]) / elapsed_s
    null = ~long
    null[long] = elapsed_s == 0
    return Values(data, null, "number")


_REDUCE: dict[str, Callable[[Floats, IntArray, IntArray], Floats]] = {
    "min": lambda samples, first, last: _segments(np.minimum, samples, first, last),
    "max": lambda samples, first, last: _segments(np.maximum, samples, first, last),
    "mean": _mean,
    "std": _std,
}
