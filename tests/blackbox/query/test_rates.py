"""Rates of items: over the time of recording, independent of pauses."""

from __future__ import annotations

from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.query.overview import JournalShare, rate_hz
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.manifest_entries import DeletionKind, Tombstone, to_record
from amberbox.core.clock import NS
from amberbox.testing.records import T0_NS, FakeItem, FakeRun, build_segments_of

TICK = FakeItem("tick", [{"n": 1}])
MAP = FakeItem("map", [{"n": 1}])
HOUR = 3600 * NS


def ticks(start_ns: int, count: int) -> list[tuple[int, FakeItem, object]]:
    return [(start_ns + n * NS // 10, TICK, {"n": n}) for n in range(count)]


def rates(store: Path) -> dict[str, float | None]:
    return {item.name: item.rate_hz for item in amberbox.open(store).items()}


@pytest.mark.parametrize("built", [0, 1, 4])
def test_pauses_between_runs_do_not_count(tmp_path: Path, built: int) -> None:
    for start_ns, count in ((T0_NS, 51), (T0_NS + HOUR, 31), (T0_NS + 9 * HOUR, 1)):
        run = FakeRun(tmp_path)
        run.write([(start_ns, MAP, {"n": 0}), *ticks(start_ns, count // 2)])
        run.rotate()
        run.write(ticks(start_ns + (count // 2) * NS // 10, count - count // 2))
        run.close()
    build_segments_of(tmp_path, built)
    assert rates(tmp_path) == {"tick": 10.0, "map": None}


@pytest.mark.parametrize(("what", "rate"), [("both", 10.0), ("raw", 0.021)])
def test_what_was_deleted_whole_does_not_count(
    tmp_path: Path, what: DeletionKind, rate: float
) -> None:
    run = FakeRun(tmp_path)
    for number in range(3):
        run.write(ticks(T0_NS + number * HOUR, 50))
        run.rotate()
    run.close()
    build_segments_of(tmp_path)
    (segment,) = [s for s in mf.read(tmp_path).segments["tick"] if s.parts[0].first_seq == 50]
    journal = segment.parts[0].journal
    (tmp_path / journal).unlink()
    stone = Tombstone(
        (journal,), what, "main", run.run, 50, 100, T0_NS + HOUR, T0_NS + HOUR + 5 * NS,
        "", "for room", True, T0_NS,
    )  # fmt: skip
    mf.append(tmp_path, [to_record(stone)])
    items = {item.name: item for item in amberbox.open(tmp_path).items()}
    assert items["tick"].rate_hz == rate
    assert items["tick"].rows == (150 if what == "raw" else 100)


def test_writers_and_slow_items() -> None:
    shares = [JournalShare(("main", 1, 10 * n), 1, n * NS, n * NS) for n in range(5)]
    assert rate_hz(shares, []) == 1.0
    assert rate_hz(shares, [("main", 1, 25), ("main", 2, 5), ("ring", 1, 5)]) == 1.0
    assert (
        rate_hz(shares, [("main", 1, 5), ("main", 1, 15), ("main", 1, 25), ("main", 1, 35)]) is None
    )
    ring = [JournalShare(("ring", 1, 0), 11, 0, NS)]
    assert rate_hz([*shares, *ring], []) == pytest.approx(14 / 5)
    assert rate_hz([], []) is None
