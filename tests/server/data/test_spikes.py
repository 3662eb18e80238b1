"""A spike of one row is shown in every window that contains it, for any number of points."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.rollups import LEVELS
from amberbox.server.data import query as reading
from amberbox.server.data.query import RowAnswer, RowQuery, rows
from amberbox.server.data.snapshot import with_snapshot
from amberbox.server.data.worker import counted
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.server.archive.recordings import Robot

_WAVE = FakeItem("wave", [{"a": 1.5, "b": 0.5}])
_EVERY_NS = 30_000_000
_ROWS = 4000
_SPIKES = {0: 1e3, 777: 1e4, 1500: -1e4, 1501: 2e4, 2998: 5e3, _ROWS - 1: 1e5}

Values = NDArray[np.float64]


@pytest.fixture(scope="module")
def values() -> Values:
    """A wave with spikes of one row and with stretches that have no value."""
    found = np.sin(np.arange(_ROWS) / 40)
    found[900:950] = np.nan
    found[list(_SPIKES)] = list(_SPIKES.values())
    return found


@pytest.fixture(scope="module")
def folder(values: Values, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two minutes of it in an archive, in columns."""
    home = tmp_path_factory.mktemp("spikes")
    archive = FolderArchive(home / "server", clock=ManualClock())
    robot = Robot("r1", home)
    run = FakeRun(robot.store, items=[_WAVE])
    run.start(T0_NS - 1)
    run.write(
        [
            (T0_NS + n * _EVERY_NS, _WAVE, {"a": value, "b": -float(n)})
            for n, value in enumerate(values.tolist())
        ]
    )
    run.close()
    robot.hand_in_all(archive)
    archive.commit(0)
    yield home / "server"


def asked(folder: Path, low: int, high: int, points: int, names: list[str]) -> RowAnswer:
    """Ask for rows ``[low, high)``, the range beginning and ending between rows."""
    span = T0_NS + low * _EVERY_NS - _EVERY_NS // 3, T0_NS + high * _EVERY_NS - _EVERY_NS // 3
    question = RowQuery("r1", "wave", names, *span, points=points)
    return with_snapshot(folder, "r1", lambda seen: rows(seen, question))


WINDOWS = st.tuples(st.integers(0, _ROWS - 1), st.integers(1, _ROWS)).map(
    lambda pair: (pair[0], min(pair[0] + pair[1], _ROWS))
)
SETTINGS = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])


@SETTINGS
@given(WINDOWS, st.integers(1, 400), st.booleans())
@example((0, _ROWS), 1, True)
def test_thinned_rows_keep_extremes(
    folder: Path, values: Values, window: tuple[int, int], points: int, both: bool
) -> None:
    answer = asked(folder, *window, points, ["a", "b"] if both else ["a"])
    shown = np.array([np.nan if v is None else v for v in answer.table.values("a")])
    inside = values[slice(*window)]
    assert answer.about.of == len(inside)
    assert len(shown) <= max(points, 10)
    if np.isnan(inside).all():
        assert np.isnan(shown).all()
        return
    assert (np.nanmin(shown), np.nanmax(shown)) == (np.nanmin(inside), np.nanmax(inside))
    assert np.isnan(inside).any() == np.isnan(shown).any()


@SETTINGS
@given(WINDOWS, st.integers(1, 400))
@example((777, 778), 1)
@example((0, _ROWS), 1)
@example((0, 3335), 1)
@example((0, 3335), 2)
def test_envelopes_keep_extremes(
    folder: Path, values: Values, window: tuple[int, int], points: int
) -> None:
    with patch.object(reading, "THINNED_ROWS", -1):
        answer = asked(folder, *window, points, ["a"])
    assert answer.about.kind == "envelope"
    low, high = (np.asarray(answer.table.columns[f"a:{end}"]) for end in ("min", "max"))
    inside = values[slice(*window)]
    if np.isnan(inside).all():
        return
    assert np.nanmin(low) <= np.nanmin(inside)
    assert np.nanmax(high) >= np.nanmax(inside)
    step_ns = len(inside) * _EVERY_NS / points
    level_ns = max((width for width in LEVELS.values() if width <= step_ns), default=LEVELS["1s"])
    around = level_ns // _EVERY_NS + 2  # a bucket that a range cuts is in it as a whole
    near = values[max(window[0] - around, 0) : window[1] + around]
    assert (np.nanmin(low), np.nanmax(high)) >= (np.nanmin(near), np.nanmax(inside))
    assert np.nanmax(high) <= np.nanmax(near)
    times = np.asarray(answer.table.columns["timestamp"])
    assert times[0] >= T0_NS + window[0] * _EVERY_NS - _EVERY_NS // 3


def test_a_bucket_that_ends_before_the_range_is_not_in_it(folder: Path, values: Values) -> None:
    second = NS // _EVERY_NS + 1
    with patch.object(reading, "THINNED_ROWS", -1):
        answer = asked(folder, 777 + 2 * second, 777 + 8 * second, 3, ["a"])
    assert np.nanmax(np.asarray(answer.table.columns["a:max"])) <= 1.0


@given(
    st.lists(st.floats(-1e6, 1e6) | st.integers(-5, 5).map(float), min_size=1, max_size=200),
    st.integers(1, 60),
)
def test_every_value_is_in_one_bar(found: list[float], bins: int) -> None:
    bars = counted(np.array(found), np.ones(len(found)), bins)
    assert bars is not None
    assert sum(bars["counts"]) == len(found)
    assert len(bars["edges"]) == len(bars["counts"]) + 1
    assert bars["edges"][0] <= min(found)
    assert bars["edges"][-1] >= max(found)


def test_whole_numbers_have_bars_of_their_own() -> None:
    bars = counted(np.array([0.0, 1, 1, 3]), np.array([1, 1, 1, 7]), 20)
    assert bars == {"edges": [-0.5, 0.5, 1.5, 2.5, 3.5], "counts": [1, 2, 0, 7]}
    assert counted(np.array([np.nan, np.inf]), np.ones(2), 20) is None
    assert counted(np.array([1.0]), np.ones(1), None) is None
