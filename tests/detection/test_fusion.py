"""Alarms combined per item: p-values of dependent scores, members, beginnings and ends."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.contracts import ScoreReason
from amberbox.detection.alarms import AlarmOptions, DetectorAlarm
from amberbox.detection.calibration import Calibration, NominalScores, calibrated
from amberbox.detection.fusion import Fusion, combined_p_value


def alarm(detector: str, leak: float, variable: str = "x", item: str = "arm") -> DetectorAlarm:
    reason = ScoreReason("odd", item, variable)
    series = f"{item}.{variable}"
    return DetectorAlarm(
        detector, series, 5 * NS, 6 * NS, 2.0, 1.0, 1e-3, "fleet", reason, leak=leak
    )


def test_simes_p_values() -> None:
    assert combined_p_value([0.01], 1) == 0.01
    assert combined_p_value([0.01], 4) == pytest.approx(0.04)
    assert combined_p_value([0.01, 0.01], 4) == pytest.approx(0.02)
    assert combined_p_value([0.03, 0.02], 2) == pytest.approx(0.03)
    assert combined_p_value([], 3) == combined_p_value([0.9], 3) == 1.0


def test_dependent_scores_are_no_more_often_rare_than_they_say() -> None:
    """Fisher's product would be, many times."""
    rng = np.random.default_rng(1)
    common = rng.normal(size=(20_000, 1))
    scores = 0.9**0.5 * common + 0.1**0.5 * rng.normal(size=(20_000, 4))
    p_values = [[math.erfc(x / 2**0.5) / 2 for x in row] for row in scores.tolist()]
    simes = [combined_p_value(row, 4) for row in p_values]
    fisher = []
    for row in p_values:
        half = -sum(map(math.log, row))  # chi-square with 8 degrees of freedom, halved
        fisher.append(math.exp(-half) * sum(half**i / math.factorial(i) for i in range(4)))
    assert np.mean(np.array(simes) < 0.01) <= 0.01
    assert np.mean(np.array(fisher) < 0.01) > 0.03


def test_members_join_and_leave_an_alarm_of_their_item() -> None:
    fusion = Fusion(3)
    first = alarm("guard", 1e-3)
    (begun,) = fusion.take([first], 10 * NS)
    assert begun.id == "combined.values.arm" and begun.leak == pytest.approx(3e-3)
    assert fusion.take([first, alarm("residual", 1e-3)], 11 * NS) == []
    (lasting,) = fusion.open_alarms
    assert lasting.leak == pytest.approx(1.5e-3) and lasting.confirmed_ns == 10 * NS
    assert "guard odd (0.001), residual odd (0.001)" in lasting.reason.text
    assert lasting.addresses == ("arm.x",)
    again = Fusion(3)
    again.resume(json.loads(json.dumps(fusion.snapshot())))
    assert again.open_alarms == fusion.open_alarms
    # one detector twice is one detector; a weaker one takes nothing away
    fusion.take([first, alarm("guard", 1e-3, "y")], 12 * NS)
    assert fusion.open_alarms[0].leak == lasting.leak
    (timing,) = fusion.take([first, alarm("event_timing", 1e-4, "")], 13 * NS)
    assert timing.id == "combined.timing.arm"
    ended = fusion.take([], 14 * NS)
    assert [(one.id, one.gone_ns) for one in ended] == [
        ("combined.values.arm", 14 * NS), ("combined.timing.arm", 14 * NS),
    ]  # fmt: skip
    fusion.take([first], 15 * NS)
    assert [one.gone_ns for one in fusion.begin(20 * NS)] == [20 * NS]


def calibration(hours: float, per_hour: float = 1.0) -> Calibration:
    """Calibrate two series on scores of so many hours."""
    rng = np.random.default_rng(2)
    found = NominalScores()
    seconds = round(hours * 3600)
    for mission in range(4):
        found.begin(0, seconds * NS // 4)
        for at_s in range(0, seconds // 4, 5):
            for series in ("a", "b"):
                found.add("fleet", series, at_s * NS + mission, float(rng.exponential()))
    return calibrated(found, per_hour, AlarmOptions())


def test_the_leak_of_an_alarm_is_that_of_its_calibration() -> None:
    known = calibration(10.0)
    one = known.thresholds["fleet"]["a"]
    at = one.nominal.p_value(one.threshold)
    # one false alarm an hour, shared by two series, in a minute
    assert known.leak("fleet", "a", at) == pytest.approx(0.5 / 60, rel=0.01)
    assert known.leak("fleet", "a", at / 10) == pytest.approx(0.05 / 60, rel=0.01)
    assert known.leak("fleet", "a", 0.0) == pytest.approx(0.5e-4 / 60, rel=0.01)
    assert known.leak("fleet", "of no nominal mission", at) > 0
    # what cannot be shown is not taken for rare
    short = calibration(0.1)
    at = short.thresholds["fleet"]["a"].nominal.p_value(short.thresholds["fleet"]["a"].threshold)
    assert short.leak("fleet", "a", at) == pytest.approx(1 - math.exp(-10 / 2 / 60), rel=0.01)
    assert replace(short, promised_per_hour=math.inf).leak("fleet", "a", 0.0) == 1.0
    assert replace(short, thresholds={}).leak("fleet", "a", 0.0) == 1.0
