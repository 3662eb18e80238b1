"""Variables summed up over a range: number of values, least, greatest, mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.query.record import wanted_columns
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.segments import columns as col
from amberbox.core.errors import UsageError
from amberbox.core.types import Column, Ragged
from amberbox.fleet.archive.envelope import envelope
from amberbox.fleet.archive.pyramid import has_levels, is_plotted
from amberbox.fleet.data.asked import MOST_ROWS, Asked
from amberbox.fleet.data.forms import about_json
from amberbox.fleet.data.look import Look
from amberbox.fleet.data.rows import THINNED_ROWS, estimate, rows

_STEPS = 1000
"""A long range is summed up from so many steps: its edges are right to a step."""


def statistics_json(look: Look, asked: Asked) -> dict[str, Any]:
    """Sum up numbers; raises UsageError for variables that are none."""
    schema = look.schema(asked.item)
    columns = [wanted.column for wanted in wanted_columns(look, schema, asked.variables)[1:]]
    texts = [column.name for column in columns if not is_plotted(column)]
    if texts and asked.variables is not None:
        raise UsageError(f"{texts[0]} is no number", "only numbers are summed up")
    numbers = [column for column in columns if is_plotted(column)]
    span = asked.from_ns, asked.to_ns
    long = estimate(look, schema, span) > THINNED_ROWS and has_levels(schema)
    if long and numbers:
        names = [column.name for column in numbers]
        table = envelope(look.reader, schema.item, names, span, _STEPS)
        found = [_of_steps(table, column, asked.bins) for column in numbers]
        return {"exact": False, "complete_to": None, "variables": found}
    answer = rows(look, _all_rows(asked, numbers))
    said = about_json(answer.about)
    found = [_of_rows(answer.table, column, asked.bins) for column in numbers]
    return {"exact": True, "complete_to": said["complete_to"], "variables": found}


def _all_rows(asked: Asked, numbers: Sequence[Column]) -> Asked:
    return Asked(
        asked.robot, asked.item, [column.name for column in numbers], asked.from_ns, asked.to_ns,
        "received", MOST_ROWS,
    )  # fmt: skip


def _of_rows(table: Table, column: Column, bins: int | None) -> dict[str, Any]:
    line = table.columns[column.name]
    assert not isinstance(line, Ragged)  # see is_plotted
    values = np.ma.getdata(line).astype(np.float64)
    known = values[~(col.null_mask(line) | np.isnan(values))]
    if not len(known):
        return _entry(column, 0, None, None, None)
    bars = counted(known, np.ones(len(known)), bins)
    return _entry(column, len(known), known.min(), known.max(), known.mean(), bars)


def _of_steps(table: Table, column: Column, bins: int | None) -> dict[str, Any]:
    low, high, mean, count = (
        np.asarray(table.columns[f"{column.name}:{state}"])
        for state in ("min", "max", "mean", "count")
    )
    total = int(count.sum())
    if not total:
        return _entry(column, 0, None, None, None)
    middle = float(np.nansum(mean * count)) / total
    known = count > 0
    bars = counted(mean[known], count[known], bins)
    return _entry(column, total, np.nanmin(low), np.nanmax(high), middle, bars)


def counted(
    values: NDArray[np.float64], weights: NDArray[Any], bins: int | None
) -> dict[str, list[Any]] | None:
    """Count values in bars: ``edges``, one more than ``counts``. None for no bins or no values.

    Whole numbers that are few enough get a bar each, about its number.
    """
    finite = np.isfinite(values)
    values, weights = values[finite], weights[finite]
    if bins is None or not len(values):
        return None
    edges = _edges(values, bins)
    counts, _ = np.histogram(values, edges, weights=weights)
    return {"edges": edges.tolist(), "counts": np.round(counts).astype(np.int64).tolist()}


def _edges(values: NDArray[np.float64], bins: int) -> NDArray[np.float64]:
    low, high = float(values.min()), float(values.max())
    if high - low < bins and bool(np.all(values == np.round(values))):
        return np.arange(low - 0.5, high + 1)
    if high - low <= 4 * bins * np.spacing(max(abs(low), abs(high))):  # no room for bars
        return np.array([low - 0.5, high + 0.5])
    return np.linspace(low, high, bins + 1)


def _entry(
    column: Column, count: int, low: Any, high: Any, mean: Any, bars: Any = None
) -> dict[str, Any]:
    shown = [None if v is None or not np.isfinite(v) else float(v) for v in (low, high, mean)]
    return {
        "name": column.name, "unit": column.unit, "count": count, "min": shown[0],
        "max": shown[1], "mean": shown[2], "histogram": bars,
    }  # fmt: skip
