"""Times at which conditions held: equal to evaluating single instants, for any division into
blocks.
"""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.blackbox.retention.missions import MissionInstant, RecordedMission
from amberbox.consult import rule_lookups
from amberbox.consult.rule_lookups import (
    ConditionCache,
    ConditionLookup,
    MissionLookup,
    StatusLookup,
    record_predicates,
)
from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.types import Level, Status
from amberbox.diagnosis.evidence.rules import LOOKED_UP
from amberbox.diagnosis.status_history import StatusHistory, StatusSpan
from amberbox.testing.records import T0_NS, FakeItem, FakeRun

A, B = FakeItem("a", [{"x": 1.0}]), FakeItem("b", [{"y": 1.0}])
Rows = list[tuple[int, FakeItem, dict[str, Any]]]


def runs_of(store: Path, chance: random.Random) -> list[Rows]:
    """Write two runs of random rows, with a pause of about an hour between them."""
    runs, at_ns = [], T0_NS
    for _ in range(2):
        rows: Rows = []
        for _ in range(60):
            at_ns += chance.randrange(1, 200) * NS // 7
            item = chance.choice([A, B])
            values = {"x": chance.choice([0.0, 1.0, 2.0])}
            rows.append((at_ns, item, values if item is A else {"y": chance.choice([0, 1, None])}))
        run = FakeRun(store, items=[A, B])
        run.write(rows)
        run.close()
        runs.append(rows)
        at_ns += 3500 * NS
    return runs


def series_of(rows: Rows, addresses: Sequence[str]) -> dict[str, Any]:
    of = {
        "a.x": [(t, values["x"]) for t, item, values in rows if item is A],
        "b.y": [(t, values["y"]) for t, item, values in rows if item is B],
    }
    return {
        name: (np.array([t for t, _ in of[name]]), np.array([v for _, v in of[name]], object))
        for name in addresses
    }


@pytest.mark.parametrize("block_s", [37, 900])
def test_intervals_say_what_single_instants_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_s: int
) -> None:
    monkeypatch.setattr(rule_lookups, "_BLOCK_NS", block_s * NS)
    chance = random.Random(block_s)
    runs = runs_of(tmp_path / "store", chance)
    window = RecordWindow(LocalRecord(tmp_path / "store"))
    for text in (
        "a.x > 0 and b.y < 1",
        "a.x > 1 for 20s",
        "age(a.x) > 10",
        "max(a.x over 60s) > 1",
    ):
        when, found = parse(text), [*ConditionLookup(window).find((text,), None)]
        spans = [(interval.from_ns, interval.to_ns) for interval in found]
        assert spans == sorted(spans)
        for rows in runs:
            series = series_of(rows, when.addresses())
            for _ in range(15):
                at_ns = chance.randrange(rows[0][0] // NS + 1, rows[-1][0] // NS) * NS
                wanted = bool(when.evaluate_series(series, at_ns))  # null is no
                assert any(first <= at_ns < last for first, last in spans) == wanted
                near = ConditionLookup(window).find((text,), (at_ns, at_ns))
                assert any(of.from_ns <= at_ns < of.to_ns for of in near) == wanted


def test_nobody_was_well_or_ill_where_nobody_watched(tmp_path: Path) -> None:
    runs_of(tmp_path / "store", random.Random(1))
    assert StatusLookup(RecordWindow(LocalRecord(tmp_path / "store"))).intervals == []


def test_what_is_kept_from_one_time_to_the_next_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rule_lookups, "_BLOCK_NS", 37 * NS)
    runs = runs_of(tmp_path / "store", random.Random(5))
    record, cache = LocalRecord(tmp_path / "store"), ConditionCache()
    read = 0
    for rows in runs:
        for at_ns in range(rows[0][0] + 20 * NS, rows[-1][0], 50 * NS):
            window = RecordWindow(record, at_ns - 300 * NS, at_ns + 1)
            for text in ("a.x > 0 and b.y < 1", "max(a.x over 60s) > 1"):
                kept = [*ConditionLookup(window, cache).find((text,), None)]
                assert kept == [*ConditionLookup(window).find((text,), None)]
                read += len(kept)
    assert read > 50


def test_a_rule_that_looks_something_up_is_known_by_its_predicates(tmp_path: Path) -> None:
    runs_of(tmp_path / "store", random.Random(1))
    window = RecordWindow(LocalRecord(tmp_path / "store"))
    assert {predicate.name for predicate in record_predicates(window)} == LOOKED_UP


def test_recent_statuses_come_before_they_are_written(tmp_path: Path) -> None:
    runs_of(tmp_path / "store", random.Random(1))
    window = RecordWindow(LocalRecord(tmp_path / "store"))
    history = StatusHistory()
    history.begin(10)
    told: list[tuple[int, Level]] = [(20, "ok"), (30, "error"), (40, "error"), (50, "ok")]
    history.take([
        Status("r", "motor", "", level, level, {}, (), at_ns, at_ns, "", "h")
        for at_ns, level in told
    ])  # fmt: skip
    recent = history.until(35)
    lookup = StatusLookup(window, recent)
    found = [(one.values, one.from_ns, one.to_ns) for one in lookup.levels((None, None), None)]
    assert found == [(("motor", "ok"), 20, 30), (("motor", "error"), 30, 36)]
    assert [one.values for one in lookup.levels(("motor", "error"), (35, 35))]
    other = StatusHistory()
    other.resume(json.loads(json.dumps(history.snapshot())))
    assert other.until(60) == history.until(60)
    history.forget_before(700 * NS)
    assert history.until(701 * NS).spans == [
        StatusSpan("motor", "ok", "ok", 100 * NS, 701 * NS + 1)
    ]


def test_a_mission_that_ends_later_still_lasts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs_of(tmp_path / "store", random.Random(1))

    def outcomes(to_s: float, late_s: float = 0) -> list[object]:
        monkeypatch.setattr(RecordWindow, "missions", lambda _: [mission])
        window = RecordWindow(LocalRecord(tmp_path / "store"), T0_NS, T0_NS + round(to_s * NS))
        lookup = MissionLookup(window, round(late_s * NS))
        return [one.values[1] for one in lookup.find((None, None), None)]

    began, ended = (MissionInstant(T0_NS + at_s * NS) for at_s in (10, 20))
    mission = RecordedMission("m", "carry", began).ended(ended, "failed")
    assert outcomes(15) == ["lasts"] and outcomes(30) == ["failed"]
    assert outcomes(22, late_s=5) == ["lasts"] and outcomes(12, late_s=5) == []
