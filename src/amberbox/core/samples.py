"""Samples of a variable over time, and windows of them, evaluated at one instant or many.

``now`` is an instant (an int, which gives one value) or an array of instants (which gives a
column); both give the same answers. A variable has the value of its last sample at or before an
instant; samples after it do not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.expressions.values import reduce_windows
from amberbox.core.types import IntArray

Now: TypeAlias = "int | IntArray"  # nanoseconds: one instant, or many in order

_ROOM = 64
_FLOAT = np.dtype(np.float64)


def is_one(now: Now) -> bool:
    """Return whether one instant is meant."""
    return not isinstance(now, np.ndarray)


class Samples:
    """Samples of one variable in order of time; old ones are dropped on request.

    Numbers are stored as int64 or float64 whatever the type of their column, so that results
    computed from them do not depend on it and never overflow.
    """

    __slots__ = ("_end", "_null", "_start", "_times", "_values")

    def __init__(self) -> None:
        self._times: IntArray = np.zeros(_ROOM, np.int64)
        self._values: NDArray[Any] = np.zeros(_ROOM)
        self._null: NDArray[np.bool_] | None = None
        self._start = self._end = 0

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def times_ns(self) -> IntArray:
        """Return the times of the samples (ns), not decreasing."""
        return self._times[self._start : self._end]

    @property
    def values(self) -> NDArray[Any]:
        """Return the values of the samples; those where ``null`` is true are undefined."""
        return self._values[self._start : self._end]

    @property
    def null(self) -> NDArray[np.bool_] | None:
        """Return which samples are unknown; None if all are known."""
        return None if self._null is None else self._null[self._start : self._end]

    def column(self) -> NDArray[Any]:
        """Return the values as expressions take them: masked where unknown."""
        null = self.null
        if null is None:
            return self.values
        if self.values.dtype != object:
            return np.ma.MaskedArray(self.values, null)
        objects = self.values.copy()
        objects[null] = None
        return objects

    def extend(self, times_ns: IntArray, values: NDArray[Any]) -> None:
        """Append samples, none of them before the last one; masked or None is unknown."""
        count = len(times_ns)
        if not count:
            return
        if self._takes_as_they_are(values, count):
            place = slice(self._end, self._end + count)
            self._times[place], self._values[place] = times_ns, values
            self._end += count
            return
        data, null = _split(values)
        if null is not None and null.all():
            data = np.zeros(count, self._values.dtype)
        self._make_room(count, data.dtype)
        if null is not None and self._null is None:
            self._null = np.zeros(len(self._times), bool)
        place = slice(self._end, self._end + count)
        self._times[place] = times_ns
        self._values[place] = data
        if self._null is not None:
            self._null[place] = False if null is None else null
        self._end += count

    def _takes_as_they_are(self, values: NDArray[Any], count: int) -> bool:
        """Return whether these are known floats that fit without conversion, as in nearly all
        cases.
        """
        return (
            type(values) is np.ndarray
            and values.dtype == _FLOAT == self._values.dtype
            and self._null is None
            and self._end + count <= len(self._times)
        )

    def _make_room(self, count: int, dtype: np.dtype[Any]) -> None:
        if self._start == self._end:
            self._start = self._end = 0
            if dtype != self._values.dtype:
                self._values = np.zeros(len(self._times), dtype)
        elif dtype != self._values.dtype:
            null = self.null
            if null is not None and null.all():
                self._values = np.zeros(len(self._times), dtype)
            else:
                self._values = self._values.astype(_common(dtype, self._values.dtype))
        if self._end + count <= len(self._times):
            return
        kept = slice(self._start, self._end)
        room = max(_ROOM, 2 * (len(self) + count))
        for name in ("_times", "_values", "_null"):
            old = getattr(self, name)
            if old is not None:
                new = np.zeros(room, old.dtype)
                new[: len(self)] = old[kept]
                setattr(self, name, new)
        self._start, self._end = 0, self._end - self._start

    def forget_before(self, time_ns: int) -> None:
        """Forget what no longer matters at ``time_ns``: all samples before the last one by then."""
        last = int(self.times_ns.searchsorted(time_ns, "right")) - 1
        if last > 0:
            self._start += last

    def clear(self) -> None:
        """Forget all samples."""
        self._start = self._end = 0
        self._null = None

    def last(self, now: Now) -> Any:
        """Return the index of the last sample at or before ``now``, -1 if there is none."""
        return self.times_ns.searchsorted(now, "right") - 1

    def at(self, now: Now) -> Any:
        """Return the value at ``now``; it is defined only where ``known``."""
        if type(now) is int and self._ends_by(now):
            return self._values[self._end - 1]
        values = self.values if len(self) else np.zeros(1, self._values.dtype)
        return values[self.last(now)]

    def known(self, now: Now) -> Any:
        """Return where there is a value."""
        if type(now) is int and self._ends_by(now):
            return np.True_ if self._null is None else ~self._null[self._end - 1]
        last = self.last(now)
        null = self.null
        if null is None or not len(null):
            return last >= 0
        return (last >= 0) & ~null[last]

    def _ends_by(self, now: int) -> bool:
        """Return whether the newest sample is the last one at an instant, as live it always is."""
        return self._end > self._start and bool(self._times[self._end - 1] <= now)

    def since_ns(self, now: Now) -> Any:
        """Return the time of the last sample at or before ``now``; there has to be one."""
        times = self.times_ns if len(self) else np.zeros(1, np.int64)
        return times[self.last(now)]

    def within(self, now: Now, seconds: float) -> Samples:
        """Return the samples that the windows of the last ``seconds`` hold, and the one before.

        At one instant, these are all values that were in force in its window. They share the
        memory of these samples and cannot be added to.
        """
        first_ns = now if is_one(now) else int(np.min(now))
        until_ns = now if is_one(now) else int(np.max(now))
        first, last = int(self.last(first_ns - round(seconds * NS))), int(self.last(until_ns))
        made = Samples.__new__(Samples)
        made._times, made._values, made._null = self._times, self._values, self._null
        made._start, made._end = self._start + max(first, 0), self._start + last + 1
        return made

    def derived(self, values: NDArray[Any], null: NDArray[np.bool_] | None = None) -> Samples:
        """Return samples at the same times with other values, one for each of these."""
        made = Samples.__new__(Samples)
        made._times, made._start, made._end = self.times_ns, 0, len(self)
        made._values, made._null = values, null
        return made


def _split(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    if isinstance(values, np.ma.MaskedArray):
        null = np.ma.getmaskarray(values)
        return _wide(np.ma.getdata(values)), null if null.any() else None
    if values.dtype == object:
        null = np.array([value is None for value in values], bool)
        return values, null if null.any() else None
    return _wide(values), None


def _wide(values: NDArray[Any]) -> NDArray[Any]:
    kind, size = values.dtype.kind, values.dtype.itemsize
    if kind == "f" or (kind == "u" and size == 8):
        return values.astype(np.float64, copy=False)
    return values.astype(np.int64, copy=False) if kind in "iu" else values


def _common(one: np.dtype[Any], other: np.dtype[Any]) -> np.dtype[Any]:
    try:
        return np.result_type(one, other)
    except TypeError:
        return np.dtype(object)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The samples of the last ``seconds`` before ``now``: times in ``(now - seconds, now]``.

    What does not exist (the least of no samples) is NaN.
    """

    samples: Samples
    now: Now
    seconds: float

    def count(self) -> Any:
        """Return how many samples there are."""
        first, end = self._bounds()
        return self._shaped(end - first)

    def min(self) -> Any:
        """Return the least value."""
        return self._extreme("min", np.min)

    def max(self) -> Any:
        """Return the greatest value."""
        return self._extreme("max", np.max)

    def mean(self) -> Any:
        """Return the mean."""
        return self._reduced("mean")

    def std(self) -> Any:
        """Return the population standard deviation."""
        return self._reduced("std")

    def rate(self) -> Any:
        """Return the change per second between the first and the last sample."""
        return self._reduced("rate")

    def changes(self) -> Any:
        """Return how many samples differ from the one before them, which may be older.

        All unknown values are alike, and so are all NaN.
        """
        values, null = self.samples.values, self.samples.null
        differs = (values[1:] != values[:-1]).astype(bool)
        if values.dtype.kind == "f":
            differs &= ~(np.isnan(values[1:]) & np.isnan(values[:-1]))
        if null is not None:
            differs = np.where(null[1:] | null[:-1], null[1:] != null[:-1], differs)
        total = np.concatenate([[0, 0], np.cumsum(differs)])[: len(values) + 1]
        first, end = self._bounds()
        return self._shaped(total[end] - total[first])

    def sum_of(self, flags: NDArray[np.bool_] | IntArray) -> Any:
        """Return how many samples of the window have their flag set, or the sum of whole numbers.

        There is one flag, or number, per sample.
        """
        total = np.concatenate([[0], np.cumsum(flags)])
        first, end = self._bounds()
        return self._shaped(total[end] - total[first])

    def _edges(self) -> tuple[IntArray, IntArray]:
        until = np.atleast_1d(np.asarray(self.now, np.int64))
        return until - round(self.seconds * NS), until

    def _bounds(self) -> tuple[IntArray, IntArray]:
        after, until = self._edges()
        times = self.samples.times_ns
        return times.searchsorted(after, "right"), times.searchsorted(until, "right")

    def _extreme(self, name: str, function: Callable[[NDArray[Any]], Any]) -> Any:
        """Return the least or greatest value; adding 0 takes the sign of -0 away."""
        if not is_one(self.now):
            return self._reduced(name) + 0.0
        first, end = (int(bound[0]) for bound in self._bounds())
        values, null = self.samples.values[first:end], self.samples.null
        if null is not None:
            values = values[~null[first:end]]
        return np.float64(function(values.astype(np.float64)) if len(values) else np.nan) + 0.0

    def _reduced(self, name: str) -> Any:
        times, values = self.samples.times_ns, self.samples.values
        null = self.samples.null
        if null is not None:
            times, values = times[~null], values[~null]
        found = reduce_windows(name, times, values.astype(np.float64), *self._edges())
        return self._shaped(np.where(found.null, np.nan, found.data))

    def _shaped(self, column: NDArray[Any]) -> Any:
        return column[0] if is_one(self.now) else column
