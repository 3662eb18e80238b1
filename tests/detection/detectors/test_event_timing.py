"""The detector of event timing: silent, late, jittery, fast and slow sources by their messages."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.contracts import LearntState, Row
from amberbox.detection.detectors import event_timing
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.detection.model_file import make_detector
from amberbox.testing.detectors import T0_NS, assert_detector_contract, mission, rows_of
from benchmarks.event_timing import Streams, as_mission, chains, first_alarm

SOURCES = ("camera_0", "camera_1", "lidar_0", "lidar_2", "gps", "odom")


def test_event_timing_is_a_detector() -> None:
    assert_detector_contract(event_timing, "event_timing")


def few(seed: int) -> Streams:
    return {name: stream for name, stream in chains(seed).items() if name in SOURCES}


@cache
def learnt() -> LearntDetector:
    detector = make_detector("event_timing")
    detector.fit([as_mission(few(seed)) for seed in range(3)])
    detector.calibrate([as_mission(few(100 + seed)) for seed in range(4)], 60.0)
    return detector


@pytest.mark.parametrize("source", ["camera_1", "lidar_0", "gps"])
@pytest.mark.parametrize(
    ("fault", "findings"),
    [
        ("crash", {"late", "silent"}),
        ("half the rate", {"late", "slow", "jitter"}),
        ("jitter", {"late", "jitter", "slow", "silent"}),
    ],
)
def test_a_fault_of_communication_is_found_and_its_source_named(
    source: str, fault: str, findings: set[str]
) -> None:
    alarm = first_alarm(learnt(), few(1000), source, fault)
    assert alarm is not None
    assert alarm.reason.item == source
    assert alarm.reason.finding in findings
    assert "by arrival" in alarm.reason.text
    assert alarm.reason.contributions


@pytest.mark.parametrize("source", ["camera_1", "odom", "gps"])
def test_a_delay_is_found_and_its_source_named_in_a_chain_and_alone(source: str) -> None:
    alarm = first_alarm(learnt(), few(1000), source, "half a period later")
    assert alarm is not None and alarm.reason.item == source
    assert alarm.reason.finding == "jitter" and "by arrival" in alarm.reason.text


def test_what_was_learnt_before_there_were_schedules_is_still_used() -> None:
    state = learnt().detector.learnt()
    older = {name: array for name, array in state.arrays.items() if name != "schedule"}
    detector = event_timing.Detector(event_timing.Config())
    detector.restore(LearntState(state.values, older))
    detector.begin(T0_NS)
    series = {score.series for row in as_mission(few(1000)) for score in detector.observe(row)}
    assert "odom/rhythm" in series and "odom/phase" not in series


def changed(kind: str) -> list[Row]:
    """Return a mission in which the GPS changes at 30 s."""
    rows = []
    for row in as_mission(few(1001)):
        if row.item != "gps" or row.at_ns < T0_NS + 30 * NS:
            rows.append(row)
        elif kind == "twice as fast":
            rows += [
                row,
                row._replace(at_ns=row.at_ns + NS // 10, stamp_ns=row.stamp_ns + NS // 10),
            ]
        elif kind == "late stamps":
            rows.append(row._replace(stamp_ns=row.stamp_ns - 3 * NS))
        else:
            rows.append(row._replace(stamp_ns=row.stamp_ns + 3 * NS))
    return rows


@pytest.mark.parametrize(
    ("kind", "finding"),
    [("twice as fast", "fast"), ("late stamps", "lag"), ("early stamps", "ahead")],
)
def test_a_fast_source_and_wrong_stamps_are_named(kind: str, finding: str) -> None:
    detector = learnt()
    detector.begin(T0_NS)
    found = detector.update(mission(changed(kind)).rows)
    assert f"event_timing.{finding}.gps" in {alarm.id for alarm in found}


def test_a_stall_of_everything_is_no_fault_of_one_source() -> None:
    """Half of the sources' messages come 60 ms late, all at once, as after a busy moment."""
    start_ns, end_ns = T0_NS + 30 * NS, T0_NS + 30 * NS + 60_000_000
    rows = [
        row._replace(at_ns=end_ns) if start_ns < row.at_ns < end_ns else row
        for row in as_mission(few(1002))
    ]
    detector = learnt()
    detector.begin(T0_NS)
    found = [alarm for alarm in detector.update(rows) if alarm.gone_ns is None]
    assert not [alarm for alarm in found if alarm.reason.finding in ("silent", "slow")]


def test_of_many_items_each_is_measured_at_messages_of_similar_rates() -> None:
    periods = np.geomspace(0.01, 1.0, 40)
    rows = [
        row
        for number, period_s in enumerate(periods.tolist())
        for row in rows_of(f"item_{number:02}", np.arange(0.0, 30.0, period_s))
    ]
    detector = event_timing.Detector(event_timing.Config(pairs=8))
    detector.fit([mission(rows)])
    pairs = detector.learnt().values["pairs"]
    assert len(pairs) == 40
    assert all(own in entry and len(entry) <= 16 for own, entry in enumerate(pairs))
    assert sum(len(entry) for entry in pairs) < 40 * 12


def test_items_with_few_messages_are_not_learnt_and_counted_later() -> None:
    rows = rows_of("often", np.arange(0, 30, 0.1)) + rows_of("rare", [3.0, 20.0])
    detector = event_timing.Detector(event_timing.Config())
    detector.fit([mission(rows)])
    assert detector.items == ["often"]
    detector.begin(T0_NS)
    for row in rows:
        detector.observe(row)
    assert detector.counts == {"messages of items that were not learnt": 2}
