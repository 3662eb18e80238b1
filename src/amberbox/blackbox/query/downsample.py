"""Thin out rows for plotting so that no extreme and no gap disappears."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.segments.columns import null_mask
from amberbox.core.types import ColumnData, IntArray, Ragged

_PER_BUCKET = 4


def downsample(columns: Sequence[ColumnData], count: int, points: int) -> IntArray:
    """Choose at most ``points`` of ``count`` rows, in order.

    The rows are cut into buckets of equal length. Of each column every bucket keeps its
    smallest and its largest value, its first and last row, and one missing value (null or NaN)
    if it has any, so that a gap stays a gap; this takes at least 5 points per column, with fewer
    something has to go. Columns that are not numbers keep the first and last row of each bucket.
    ``tsdownsample`` is used where installed, with the same guarantee.
    """
    if count <= points:
        return np.arange(count)
    share = max(points // max(len(columns), 1), _PER_BUCKET)
    chosen = [_choose(column, share) for column in columns] or [_edges(count, points // 2)]
    rows = np.unique(np.concatenate(chosen))
    return rows if len(rows) <= points else rows[_evenly(len(rows), points)]


def _evenly(count: int, points: int) -> IntArray:
    places: IntArray = np.linspace(0, count - 1, points).astype(np.int64)
    return places


def _choose(column: ColumnData, points: int) -> IntArray:
    values = None if isinstance(column, Ragged) else _as_numbers(column)
    if values is None:
        return _edges(len(column), max(points // 2, 1))
    missing = _missing(column, values)
    if missing.any():
        return _extremes(values, missing, max(points // (_PER_BUCKET + 1), 1))
    return _m4(values, max(points // _PER_BUCKET, 1))


def _as_numbers(column: NDArray[Any]) -> NDArray[Any] | None:
    values = np.ma.getdata(column)
    if values.dtype == bool:
        return values.view(np.uint8)
    return values if values.dtype.kind in "iuf" else None


def _missing(column: ColumnData, values: NDArray[Any]) -> NDArray[np.bool_]:
    nulls = null_mask(column)
    return nulls | np.isnan(values) if values.dtype.kind == "f" else nulls


def _m4(values: NDArray[Any], buckets: int) -> IntArray:
    try:
        from tsdownsample import M4Downsampler
    except ImportError:
        return _extremes(values, np.zeros(len(values), bool), buckets)
    sampler: Any = M4Downsampler
    rows = sampler().downsample(np.ascontiguousarray(values), n_out=buckets * _PER_BUCKET)
    return np.asarray(rows, np.int64)


def _bounds(count: int, buckets: int) -> IntArray:
    """Return the first row of each bucket, and the end of the last."""
    edges: IntArray = np.linspace(0, count, min(buckets, count) + 1).astype(np.int64)
    return edges


def _edges(count: int, buckets: int) -> IntArray:
    edges = _bounds(count, max(buckets, 1))
    return np.concatenate((edges[:-1], edges[1:] - 1))


def _extremes(values: NDArray[Any], missing: NDArray[np.bool_], buckets: int) -> IntArray:
    edges = _bounds(len(values), buckets)
    low, high = _limits(values.dtype)
    smallest = _first_equal(np.where(missing, high, values), np.minimum, edges)
    largest = _first_equal(np.where(missing, low, values), np.maximum, edges)
    rows = [_edges(len(values), buckets), smallest, largest]
    if missing.any():
        rows.append(_first_per_bucket(missing, edges))
    return np.unique(np.concatenate(rows))


def _limits(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    if dtype.kind == "f":
        return dtype.type(-np.inf), dtype.type(np.inf)
    return np.iinfo(dtype).min, np.iinfo(dtype).max


def _first_equal(values: NDArray[Any], ufunc: np.ufunc, edges: IntArray) -> IntArray:
    """Return for each bucket the first row that holds its extreme."""
    extremes = ufunc.reduceat(values, edges[:-1])
    return _first_per_bucket(values == np.repeat(extremes, np.diff(edges)), edges)


def _first_per_bucket(hits: NDArray[np.bool_], edges: IntArray) -> IntArray:
    rows = np.flatnonzero(hits)
    first: IntArray = rows[
        np.unique(np.searchsorted(edges, rows, side="right"), return_index=True)[1]
    ]
    return first
