"""Matrix and sparklines."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as some

from amberbox.core.robot_status import SEVERITIES
from amberbox.diagnosis.fmea.criticality import LEVELS
from amberbox.server.drawing.charts import (
    MatrixCell,
    MatrixChart,
    criticality_matrix,
    criticality_zone,
    spark,
)
from tests.server.drawing.parsed import (
    HOSTILE,
    WORDS,
    frames,
    of_class,
    overlapping,
    parsed,
    texts,
    titles,
)

ROWS = [level for level, _ in LEVELS]
MATRIX = MatrixChart(
    ROWS,
    SEVERITIES,
    {
        (ROWS[0], "fatal"): MatrixCell(3, "/worst", chosen=True),
        (ROWS[4], "warning"): MatrixCell(44),
    },
)


def test_every_cell_is_drawn() -> None:
    """Draw a box for each pair, with its count, its words and its link."""
    tree = parsed(criticality_matrix(MATRIX, label="How critical", words=WORDS))
    cells = frames(tree, "cell")
    assert len(cells) == len(ROWS) * len(SEVERITIES)
    assert not overlapping(cells)
    counts = [part.text for part in of_class(tree, "count")]
    assert (counts.count("3"), counts.count("44"), counts.count("·")) == (1, 1, len(cells) - 2)
    assert "3 failure modes: A frequent, fatal" in titles(tree)
    assert [part.get("href") for part in tree.iter() if part.get("href")] == ["/worst"]
    assert {*ROWS, *SEVERITIES} <= set(texts(tree))
    assert len(of_class(tree, "chosen")) == 1


def test_zones_grow_towards_the_worst_corner() -> None:
    """Be the darker the worse and the more frequent."""
    zones = [[criticality_zone(row, column, 5, 4) for column in range(4)] for row in range(5)]
    assert (zones[4][0], zones[0][3]) == (1, 4)
    assert all(row == sorted(row) for row in zones)
    assert all(list(column) == sorted(column, reverse=True) for column in zip(*zones, strict=True))
    assert criticality_zone(0, 0, 1, 1) == 1


@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_labels_are_text(hostile: str) -> None:
    """Draw any label as text."""
    matrix = MatrixChart([hostile], [hostile], {(hostile, hostile): MatrixCell(1)})
    tree = parsed(criticality_matrix(matrix, label=hostile, words=WORDS))
    assert not {"script", "img"} & {part.tag.rpartition("}")[2] for part in tree.iter()}


def _line(values: list[float | None]) -> tuple[list[list[tuple[float, float]]], str]:
    drawing = spark(values, label="x")
    path = next(iter(of_class(parsed(drawing), "spark-line"))).get("d", "")
    runs = [re.findall(r"(-?[\d.]+) (-?[\d.]+)", run) for run in path.split("M")[1:]]
    return [[(float(x), float(y)) for x, y in run] for run in runs], path


def test_line_goes_through_the_values() -> None:
    """Put the highest on top and the lowest at the bottom."""
    (run,), _ = _line([0.0, 10.0, 5.0])
    assert run == [(3, 21), (48, 3), (93, 12)]


def test_gaps_part_the_line() -> None:
    """Draw nothing where nothing is known; a single value is a dot."""
    runs, path = _line([1.0, 2.0, math.nan, 3.0, None, 4.0, 5.0])
    assert [len(run) for run in runs] == [2, 1, 2]
    assert path.count("h.1") == 1


def test_spikes_survive() -> None:
    """Keep the lowest and the highest of many values."""
    values: list[float | None] = [0.0] * 5000
    values[3210], values[17] = 9.0, -9.0
    (run,), _ = _line(values)
    heights = [y for _, y in run]
    assert len(run) <= 100
    assert (heights.count(3), heights.count(21)) == (1, 1)


@given(some.lists(some.none() | some.floats(), max_size=250))
def test_any_values_stay_inside(values: list[float | None]) -> None:
    """The line stays inside the drawing, whatever the values are."""
    drawing = spark(values, label="x")
    assert drawing.get("aria-label") == "x"
    known = [value for value in values if value is not None and math.isfinite(value)]
    if not known:
        assert not of_class(parsed(drawing), "spark-line")
        return
    runs, _ = _line(values)
    assert all(2.9 <= x <= 93.1 and 2.9 <= y <= 21.1 for run in runs for x, y in run)


def test_constant_value_is_a_line_in_the_middle() -> None:
    """Draw a level line where nothing changes."""
    (run,), _ = _line([7.0, 7.0])
    assert {y for _, y in run} == {12.0}
