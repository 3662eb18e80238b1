"""The pyramid: least, greatest and mean of every step are those of the rows."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.server.archive.folder import FolderArchive
from amberbox.testing.records import T0_NS, FakeItem, FakeRun
from tests.server.archive.recordings import Robot

_ITEM = FakeItem("wave", [{"a": 1.5, "n": 1, "on": True, "text": "x"}, {"n": 1}])
_START_NS = (T0_NS // (3600 * NS) + 1) * 3600 * NS


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> FolderArchive:
    """An archive that all tests here share."""
    return FolderArchive(tmp_path_factory.mktemp("archive") / "server")


@pytest.fixture(scope="module")
def values(archive: FolderArchive, tmp_path_factory: pytest.TempPathFactory) -> NDArray[np.float64]:
    """Two hours of a wave with holes, one row each 2 s, in files of 10 minutes, committed."""
    a: NDArray[np.float64] = np.sin(np.arange(3600) / 50) * np.arange(3600)
    a[100:140] = np.nan
    robot = Robot("r1", tmp_path_factory.mktemp("robot"))
    run = FakeRun(robot.store, items=[_ITEM])
    for start in range(0, 3600, 300):
        rows = []
        for n in range(start, start + 300):
            some = {} if np.isnan(a[n]) else {"a": float(a[n])}
            rows.append(
                (_START_NS + n * 2 * NS, _ITEM, {"n": n, "on": n % 2 == 0, "text": "x"} | some)
            )
        run.write(rows)
        run.rotate()
    run.close()
    robot.hand_in_all(archive)
    archive.commit()
    return a


@pytest.mark.parametrize(("points", "width_s"), [(2, 3600), (10, 720), (120, 60), (1800, 4)])
def test_steps_say_what_their_rows_say(
    archive: FolderArchive,
    values: NDArray[np.float64],
    points: int,
    width_s: int,
) -> None:
    span = _START_NS, _START_NS + 7200 * NS
    table = archive.robot("r1").envelope("wave", ["a", "n"], *span, points=points)
    edges = np.arange(0, 3601, width_s // 2)
    assert len(table) == len(edges) - 1
    assert table.values("timestamp") == [_START_NS + int(e) * 2 * NS for e in edges[:-1]]
    for row, (low, high) in zip(table.rows(), pairwise(edges), strict=True):
        known = values[low:high][~np.isnan(values[low:high])]
        assert row["a:count"] == len(known)
        assert (row["n:min"], row["n:max"], row["n:count"]) == (low, high - 1, high - low)
        if len(known):
            assert (row["a:min"], row["a:max"]) == (known.min(), known.max())
            assert row["a:mean"] == pytest.approx(known.mean(), rel=1e-9, abs=1e-9)
        else:
            assert np.isnan(row["a:min"])
            assert np.isnan(row["a:mean"])


def test_joined_files_give_the_same_steps(
    archive: FolderArchive, values: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    del values
    before = list(archive.robot("r1").envelope("wave", ["n", "on"], points=7).rows())
    monkeypatch.setattr("amberbox.server.archive.commit.COUNT", 1)
    assert archive.compact() > 0
    assert list(archive.robot("r1").envelope("wave", ["n", "on"], points=7).rows()) == before


def test_texts_have_no_envelope(archive: FolderArchive, values: object) -> None:
    del values
    with pytest.raises(UsageError, match="text is no number"):
        archive.robot("r1").envelope("wave", ["text"])


def test_several_robots_have_their_own_steps(
    archive: FolderArchive, values: object, tmp_path: Path
) -> None:
    del values
    other = Robot("r2", tmp_path)
    run = FakeRun(other.store, items=[_ITEM])
    run.write([(_START_NS + n * NS, _ITEM, {"n": -n}) for n in range(10)])
    run.close()
    other.hand_in_all(archive)
    archive.commit(0.0)
    span = _START_NS, _START_NS + 20 * NS
    table = archive.robot().envelope("wave", ["n"], *span, points=2)
    told = [(r["robot"], r["n:min"], r["n:max"], r["n:count"]) for r in table.rows()]
    assert sorted(told) == [("r1", 0, 4, 5), ("r1", 5, 9, 5), ("r2", -9, 0, 10)]
