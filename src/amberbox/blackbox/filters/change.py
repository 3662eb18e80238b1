"""Keep a message only when something in it has changed enough, or has been silent too long.

A row is kept when a watched variable differs from the last kept row by more than its dead band,
when the number of rows in a child table differs, or when the heartbeat is due. The answer does not
depend on how the stream is cut into batches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.filters.series import Series, flatten, joined
from amberbox.blackbox.filters.watched import watched
from amberbox.core.errors import UsageError
from amberbox.core.source import ChangeOptions
from amberbox.core.types import IntArray, ItemSchema, Rows

FIRST_WINDOW = 16

BoolArray = NDArray[np.bool_]


class ChangeFilter:
    """The change filter of one item, for as long as its schema stays the same.

    ``unused`` holds the names in the options that fit no variable (or, with a band, no number).
    A widened schema needs a filter of its own; its first row is kept, as a change of schema is
    a change.
    """

    def __init__(self, options: ChangeOptions, schema: ItemSchema) -> None:
        _refuse_nonsense(options)
        self.schema = schema
        self._watched, self.unused = watched(schema, options)
        self._heartbeat_ns = _heartbeat_ns(options.heartbeat_s)
        self._last: list[Series] = []
        self._last_ns = 0

    def mask(self, rows: Rows, received_ns: IntArray) -> BoolArray:
        """Tell which rows to keep; ``received_ns`` is their time of receipt, in order."""
        if not rows.count:
            return np.zeros(0, bool)
        series = list(flatten(rows, self._watched))
        if self._last:
            series = joined(self._last, series)
            received_ns = np.concatenate([[self._last_ns], received_ns])
        kept = _keep(series, received_ns, self._heartbeat_ns)
        last = int(np.flatnonzero(kept)[-1])
        keeps_none_of_these = bool(self._last) and last == 0
        answer = kept[1:] if self._last else kept
        if not keeps_none_of_these:
            self._last = [one.row(last) for one in series]
            self._last_ns = int(received_ns[last])
        return answer


def _keep(series: Sequence[Series], received_ns: IntArray, heartbeat_ns: float) -> BoolArray:
    """Tell which rows to keep of rows whose first one is kept (or was, in the batch before).

    Where any difference counts, comparing with the row before is enough: that row was either
    kept, or equal to the last kept one. Only dead bands and the heartbeat need the last kept row.
    """
    count = len(received_ns)
    kept = _differs_from_row_before(series, count)
    kept[0] = True
    forced = [*np.flatnonzero(kept).tolist(), count]
    banded = _Banded(series, received_ns, heartbeat_ns)
    for start, stop in itertools.pairwise(forced):
        row = start
        while (row := banded.next_kept(row, stop)) < stop:
            kept[row] = True
    return kept


class _Banded:
    """The series that have dead bands, ready to be compared with any row."""

    def __init__(
        self, series: Sequence[Series], received_ns: IntArray, heartbeat_ns: float
    ) -> None:
        self._received_ns = received_ns
        self._heartbeat_ns = heartbeat_ns
        self._series = [one for one in series if one.bands is not None]

    def next_kept(self, last: int, stop: int) -> int:
        """Return the first row after ``last`` and before ``stop`` to keep, else ``stop``.

        No list changes its length from ``last`` to there.
        """
        start, width = last + 1, FIRST_WINDOW
        while start < stop:
            end = min(start + width, stop)
            hits = self._exceeds(last, start, end)
            if hits.any():
                return start + int(hits.argmax())
            start, width = end, 2 * width
        return stop

    def _exceeds(self, last: int, start: int, end: int) -> BoolArray:
        silent_ns = np.abs(self._received_ns[start:end] - self._received_ns[last])
        hits: BoolArray = silent_ns >= self._heartbeat_ns
        for one in self._series:
            hits |= _beyond_band(one, last, start, end)
        return hits


def _beyond_band(one: Series, last: int, start: int, end: int) -> BoolArray:
    """Tell which rows differ from row ``last`` by more than the wider of the two bands."""
    assert one.bands is not None
    reference = one.of_rows(last, last + 1).astype(np.float64)
    window = one.of_rows(start, end).reshape(end - start, *reference.shape)
    with np.errstate(invalid="ignore", over="ignore"):  # inf - inf: see _special
        width = np.maximum(one.bands.absolute, one.bands.relative * np.abs(reference))
        beyond = np.abs(window - reference) > width
    return np.asarray(beyond.any(axis=(1, 2)), bool)


def _differs_from_row_before(series: Sequence[Series], count: int) -> BoolArray:
    """Tell which rows differ in what has no dead band; the first row never does."""
    differs = np.zeros(count, bool)
    for one in series:
        differs[1:] |= _single_differs(one) if one.offsets is None else _list_differs(one)
    return differs


def _single_differs(one: Series) -> BoolArray:
    differs = np.zeros(len(one.values) - 1, bool)
    for values in _exact_parts(one):
        differs |= _unequal(values[1:], values[:-1])
    return differs


def _list_differs(one: Series) -> BoolArray:
    assert one.offsets is not None
    lengths = np.diff(one.offsets)
    differs: BoolArray = lengths[1:] != lengths[:-1]
    begin, end = int(one.offsets[1]), int(one.offsets[-1])
    here = np.arange(begin, end)
    # An element's partner stands one list before it; where lengths differ that no longer matters.
    before = here - np.repeat(lengths[:-1], lengths[1:])
    for values in _exact_parts(one):
        unequal = _unequal(values[here], values[np.maximum(before, 0)])
        count = np.concatenate([[0], np.cumsum(unequal)])
        places = one.offsets[1:] - begin
        differs = differs | (count[places[1:]] > count[places[:-1]])
    return differs


def _exact_parts(one: Series) -> list[NDArray[Any]]:
    """Return what of a series counts as changed by any difference."""
    nulls = [] if one.nulls is None else [one.nulls]
    if one.bands is None:
        return [one.values, *nulls]
    return [_special(one.values), *nulls] if one.values.dtype.kind == "f" else nulls


def _special(values: NDArray[Any]) -> NDArray[np.int8]:
    """Mark what no dead band applies to: NaN and the two infinities."""
    marks = np.zeros(values.shape, np.int8)
    marks[np.isposinf(values)] = 1
    marks[np.isneginf(values)] = 2
    marks[np.isnan(values)] = 3
    return marks


def _unequal(first: NDArray[Any], second: NDArray[Any]) -> BoolArray:
    """Tell which lines differ in any value; NaN equals NaN."""
    unequal = np.asarray(first != second, bool)
    if first.dtype.kind == "f":
        unequal &= ~(np.isnan(first) & np.isnan(second))
    return np.asarray(unequal.any(axis=1), bool)


def _heartbeat_ns(heartbeat_s: float) -> float:
    return heartbeat_s * 1e9 if heartbeat_s else math.inf


def _refuse_nonsense(options: ChangeOptions) -> None:
    numbers = {"absolute": options.absolute, "relative": options.relative}
    numbers |= {"heartbeat_s": options.heartbeat_s}
    numbers |= {f"bands.{name}": width for name, width in options.bands.items()}
    for key, value in numbers.items():
        if not value >= 0:
            raise UsageError(f"change.{key} is {value:g}", "give a number that is 0 or more")
