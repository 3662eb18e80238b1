"""Lists of numbers, such as the ranges of a scan, by a few figures per row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from amberbox.core.types import Ragged

FIGURES = ("count", "finite", "min", "max", "mean")
"""How long the list is, how many of it are finite, and these figures of what is finite."""


def figures_of(column: Any, rows: int) -> Mapping[str, Any]:
    """Return each figure as a column; unknown for rows without such a list."""
    if not isinstance(column, Ragged) or column.values.dtype.kind not in "biuf":
        unknown = np.ma.MaskedArray(np.zeros(rows), np.ones(rows, bool))
        return dict.fromkeys(FIGURES, unknown)
    values = column.values[: column.offsets[-1]].astype(np.float64)
    finite = np.isfinite(values)
    starts, counts = column.offsets[:-1], np.diff(column.offsets)
    number = _reduced(np.add, finite.astype(np.float64), starts, counts, 0.0)
    total = _reduced(np.add, np.where(finite, values, 0.0), starts, counts, 0.0)
    with np.errstate(all="ignore"):
        mean = total / number
    low = _reduced(np.minimum, np.where(finite, values, np.inf), starts, counts, np.inf)
    high = _reduced(np.maximum, np.where(finite, values, -np.inf), starts, counts, -np.inf)
    none = number == 0
    return {
        "count": counts.astype(np.float64),
        "finite": number,
        "min": np.where(none, np.nan, low),
        "max": np.where(none, np.nan, high),
        "mean": mean,
    }


def _reduced(function: np.ufunc, values: Any, starts: Any, counts: Any, empty: float) -> Any:
    """Reduce the values of each row; ``empty`` where there are none."""
    found = np.full(len(starts), empty)
    some = counts > 0
    if some.any():
        found[some] = function.reduceat(values, starts[some])
    return found
