"""Thinning out: never too many rows, never an extreme or a gap lost."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns.arrays import objects
from amberbox.blackbox.query.table import downsample
from amberbox.core.types import ColumnData, Ragged


@pytest.fixture(params=["tsdownsample", "numpy"])
def library(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "numpy":
        monkeypatch.setitem(sys.modules, "tsdownsample", None)
    return str(request.param)


def series(kind: str, count: int = 10_007) -> ColumnData:
    random = np.random.default_rng(7)
    walk = np.cumsum(random.normal(size=count))
    if kind == "bool":
        return random.random(count) < 0.001
    return (walk * 1000 + (2**40 if kind == "uint64" else 0)).astype(kind)


@pytest.mark.usefixtures("library")
@pytest.mark.parametrize("kind", ["float64", "float32", "int64", "int32", "uint64", "bool"])
def test_buckets_keep_their_extremes(kind: str) -> None:
    column = np.asarray(series(kind))
    rows = downsample([column], len(column), 400)
    assert len(rows) <= 400
    assert (np.diff(rows) > 0).all()
    assert {0, len(column) - 1} <= set(rows.tolist())
    for part in np.array_split(np.arange(len(column)), 50):  # two buckets wide: always holds one
        kept = column[rows[(rows >= part[0] - 101) & (rows <= part[-1] + 101)]]
        assert kept.max() >= column[part].max()
        assert kept.min() <= column[part].min()


@pytest.mark.usefixtures("library")
def test_gaps_stay_gaps() -> None:
    column = np.asarray(series("float64"))
    column[3000:3400] = np.nan
    rows = downsample([column], len(column), 500)
    assert len(rows) <= 500
    assert np.isnan(column[rows[(rows >= 3000) & (rows < 3400)]]).any()
    assert column[rows][~np.isnan(column[rows])].max() == np.nanmax(column)


@pytest.mark.usefixtures("library")
def test_nulls_are_no_values() -> None:
    data = np.arange(1000)
    data[500] = 10**9
    column = np.ma.masked_array(data, mask=np.arange(1000) == 500)
    rows = downsample([column], 1000, 50)
    assert 999 in rows
    assert len(rows) <= 50


@pytest.mark.usefixtures("library")
def test_several_variables_share_their_rows() -> None:
    first, second = np.asarray(series("float64")), -(np.asarray(series("int64")) ** 2)
    rows = downsample([first, second], len(first), 800)
    assert len(rows) <= 800
    assert {int(first.argmax()), int(second.argmin())} <= set(rows.tolist())


def test_few_rows_stay_as_they_are() -> None:
    assert downsample([np.arange(5)], 5, 5).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "column",
    [objects(["a", "b"] * 500), Ragged(np.arange(1001), np.arange(1000.0))],
    ids=["text", "lists"],
)
def test_columns_without_an_order_are_thinned_evenly(column: ColumnData) -> None:
    rows = downsample([column], 1000, 20)
    assert len(rows) <= 20
    assert np.diff(rows).max() < 150


def test_never_more_rows_than_asked_for() -> None:
    columns = [np.random.default_rng(seed).normal(size=1000) for seed in range(7)]
    assert [len(downsample(columns, 1000, points)) for points in (1, 2, 10)] == [1, 2, 10]


def test_without_variables_rows_are_thinned_evenly() -> None:
    rows = downsample([], 1000, 20)
    assert 10 <= len(rows) <= 20


@settings(max_examples=60)
@given(
    st.lists(st.floats(width=32) | st.just(float("nan")), min_size=1, max_size=300),
    st.integers(5, 60),
)
def test_global_extremes_are_always_kept(values: list[float], points: int) -> None:
    column = np.array(values)
    rows = downsample([column], len(column), points)
    assert len(rows) <= points
    real = column[~np.isnan(column)]
    if len(real):
        kept = column[rows]
        assert np.nanmin(kept) == real.min()
        assert np.nanmax(kept) == real.max()
