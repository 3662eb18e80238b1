"""What stands around every detector: streams, checkpoints, clocks, thresholds, alarms."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.contracts import Row
from amberbox.core.errors import AmberboxError
from amberbox.detection.alarms import AlarmOptions, DetectorAlarm, alarm_to_json
from amberbox.detection.detectors import event_timing, guard
from amberbox.detection.learnt_detector import LearntDetector
from amberbox.testing.detectors import (
    T0_NS,
    GivenMission,
    given_rows,
    mission,
    nominal_missions,
    rows_of,
)

MISSIONS = nominal_missions(6)


def learnt(name: str = "guard", rate: float = 100.0) -> LearntDetector:
    module = {"guard": guard, "event_timing": event_timing}[name]
    detector = LearntDetector(name, module.Detector(module.Config()))
    detector.fit(MISSIONS[:3])
    detector.calibrate(MISSIONS[3:], rate)
    return detector


GUARD, TIMING = learnt("guard"), learnt("event_timing")
DETECTORS = {"guard": GUARD, "event_timing": TIMING}


def faulty(seconds: float = 20.0) -> list[Row]:
    """Return a mission in which the wheel stops at 8 s and the imu jumps at 12 s."""
    rows = list(nominal_missions(1, seconds, seed=9)[0])
    kept = [row for row in rows if row.item != "wheel" or row.at_ns < T0_NS + 8 * NS]
    return [
        row._replace(values={**row.values, "a": 50.0})
        if row.item == "imu" and row.at_ns > T0_NS + 12 * NS
        else row
        for row in kept
    ]


def plain(alarms: Iterable[DetectorAlarm]) -> list[str]:
    return [json.dumps(alarm_to_json(alarm)) for alarm in alarms]


def in_one_batch(detector: LearntDetector, rows: Sequence[Row], end_ns: int) -> list[str]:
    detector.begin(T0_NS)
    return plain([*detector.update(rows), *detector.tick(end_ns)])


@pytest.mark.parametrize("name", DETECTORS)
@settings(max_examples=10, database=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.integers(0, 560), max_size=8), st.integers(0, 560))
def test_batches_ticks_and_checkpoints_change_no_alarm(
    name: str, cuts: list[int], stop: int
) -> None:
    detector, rows = DETECTORS[name], faulty()
    end_ns = rows[-1].at_ns + 5 * NS
    expected = in_one_batch(detector, rows, end_ns)
    assert expected
    detector.begin(T0_NS)
    found: list[DetectorAlarm] = []
    places = sorted({0, *(min(cut, len(rows)) for cut in (*cuts, stop)), len(rows)})
    for first, last in itertools.pairwise(places):
        if first == stop:
            checkpoint = json.loads(json.dumps(detector.snapshot()))
            detector.begin(T0_NS + 999)
            detector.resume(checkpoint)
        found += detector.update(rows[first:last])
        found += detector.tick(rows[last - 1].at_ns)
    found += detector.tick(end_ns)
    assert plain(found) == expected


@pytest.mark.parametrize("name", DETECTORS)
def test_scores_of_a_mission_do_not_depend_on_what_follows(name: str) -> None:
    detector, rows = DETECTORS[name], faulty()
    whole = detector.score(mission(rows))
    head = detector.score(GivenMission("head", rows[:200], (rows[0].at_ns, rows[199].at_ns)))
    assert len(head) > 100
    for column in ("at_ns", "value", "standardised", "p_value"):
        ours, theirs = getattr(head, column), getattr(whole, column)[: len(head)]
        assert np.array_equal(ours, theirs, equal_nan=True), column


def test_alarms_name_what_stopped_and_what_left_its_range() -> None:
    for detector, wanted in (
        (GUARD, {"guard.silent.wheel", "guard.range.imu.a", "guard.frozen.imu.a"}),
        (TIMING, {"event_timing.silent.wheel"}),
    ):
        detector.begin(T0_NS)
        found = {alarm.id: alarm for alarm in detector.update(faulty())}
        assert wanted <= found.keys(), found.keys()
        for name in wanted:
            alarm = found[name]
            assert alarm.onset_ns <= alarm.confirmed_ns
            assert alarm.score > alarm.threshold
            assert 0 <= alarm.p_value < 0.01
            assert alarm.reason.text


def test_total_silence_is_seen_by_ticks_alone() -> None:
    rows = nominal_missions(1, 10.0, seed=5)[0].rows
    for detector in DETECTORS.values():
        detector.begin(T0_NS)
        detector.update(rows)
        found = detector.tick(rows[-1].at_ns + 20 * NS)
        assert {"imu", "wheel"} <= {alarm.reason.item for alarm in found}
        assert {alarm.reason.finding for alarm in found} == {"silent"}


def test_an_alarm_ends_when_the_fault_does() -> None:
    rows = faulty(20.0)
    later = [
        row._replace(at_ns=row.at_ns + 21 * NS, stamp_ns=row.stamp_ns + 21 * NS)
        for row in nominal_missions(1, 20.0, seed=10)[0]
    ]
    GUARD.begin(T0_NS)
    found = GUARD.update([*rows, *later])
    begun = {alarm.series: alarm for alarm in found if alarm.gone_ns is None}
    ended = {alarm.series: alarm for alarm in found if alarm.gone_ns is not None}
    assert {"wheel/silence", "imu/range"} <= begun.keys() & ended.keys()
    symptom = ended["imu/range"].symptom()
    assert (symptom.id, symptom.state) == ("guard.range.imu.a", "absent")
    assert symptom.evidence[0][0] == "imu.a"


def test_persistence_delays_the_confirmation_and_not_the_onset() -> None:
    patient = LearntDetector("guard", guard.Detector(guard.Config()), AlarmOptions(persist_s=1.0))
    patient.fit(MISSIONS[:3])
    patient.calibrate(MISSIONS[3:], 100.0)
    patient.begin(T0_NS)
    alarm = next(a for a in patient.update(faulty()) if a.id == "guard.range.imu.a")
    assert NS <= alarm.confirmed_ns - alarm.onset_ns < 2 * NS


@pytest.mark.parametrize("name", DETECTORS)
def test_clock_steps_late_rows_and_silences_are_counted(name: str) -> None:
    detector = learnt(name)
    rows = list(MISSIONS[0].rows[:100])
    detector.begin(T0_NS)
    detector.update(rows)
    detector.update([rows[0], rows[99]._replace(at_ns=rows[99].at_ns + 100 * NS)])
    detector.update([row._replace(at_ns=rows[50].at_ns - 1) for row in rows[50:51]])
    detector.update([rows[0]._replace(at_ns=2**80)])
    detector.update([rows[99], rows[99]._replace(at_ns=rows[99].at_ns - NS // 2)])
    counts = detector.counts
    assert counts["steps of the clock back by more than a second"] == 2
    assert counts["silences of everything for more than a minute"] == 1
    assert counts["rows whose time cannot be"] == 1
    assert counts["rows out of order"] == 1


def test_calibration_says_what_cannot_be_promised() -> None:
    detector = learnt(rate=0.5)
    assert detector.calibration is not None
    hours = 60 / 3600
    assert detector.calibration.hours == pytest.approx(hours, rel=0.02)
    assert detector.calibration.promised_per_hour == pytest.approx(1 / hours, rel=0.02)
    assert "no rate below" in " ".join(detector.calibration.report())
    often = learnt(rate=200.0).calibration
    assert often is not None and often.report()[1:] == []


def test_missions_that_differ_too_much_to_keep_to_a_rate_are_reported() -> None:
    later = [
        mission([row._replace(values={**row.values, "c": 100.0**n}) for row in given])
        for n, given in enumerate(MISSIONS[3:], 1)
    ]
    detector = LearntDetector("guard", guard.Detector(guard.Config()))
    detector.fit(MISSIONS[:3])
    report = detector.calibrate(later, 1.0).report()
    assert any("more than asked for" in line for line in report)


def test_a_lower_rate_never_lowers_a_threshold() -> None:
    few, many = learnt(rate=1.0).calibration, learnt(rate=500.0).calibration
    assert few is not None and many is not None
    for baseline, part in few.thresholds.items():
        for series, one in part.items():
            assert one.threshold >= many.thresholds[baseline][series].threshold


def test_nominal_missions_have_no_more_alarms_than_asked() -> None:
    """Fresh nominal missions: at 60 an hour, 100 s may have a few alarms and not dozens."""
    detector = learnt(rate=60.0)
    seconds = set()
    for fresh in nominal_missions(5, seed=33):
        detector.begin(fresh.span[0])
        alarms = detector.update(fresh.rows)
        seconds |= {(fresh.name, a.confirmed_ns // (10 * NS)) for a in alarms if not a.gone_ns}
    assert len(seconds) <= 5


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan, math.inf])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    detector = LearntDetector("guard", guard.Detector(guard.Config()))
    detector.fit(MISSIONS[:1])
    with pytest.raises(AmberboxError, match="rate of false alarms"):
        detector.calibrate(MISSIONS[1:2], rate)


def test_missions_without_rows_are_refused_with_a_reason() -> None:
    empty = mission([])
    for module in (guard, event_timing):
        detector = LearntDetector(module.__name__, module.Detector(module.Config()))
        with pytest.raises(AmberboxError, match="no item has 20 messages"):
            detector.fit([empty])
        detector.fit([empty, *MISSIONS[:1], given_rows("one", [1.0], {"x": [1.0]})])
        with pytest.raises(AmberboxError, match="no scores"):
            detector.calibrate([mission(rows_of("other", [0.0, 0.1], {"x": [1.0, 2.0]}))], 1.0)


def test_a_checkpoint_of_another_detector_is_refused() -> None:
    for wrong in ({}, {"detector": 1}, TIMING.snapshot(), {"last_ns": "x", "detector": {}}):
        with pytest.raises(AmberboxError, match="does not fit"):
            GUARD.resume(wrong)
