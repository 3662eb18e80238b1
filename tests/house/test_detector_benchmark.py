"""Detectors in the accuracy experiment: what they are fed and tell, and the comparison."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.core.contracts import ScoreReason
from amberbox.core.given_findings import findings_in
from amberbox.detection.alarms import DetectorAlarm
from amberbox.sim.disturbances import parse_disturbance
from amberbox.sim.faults import catalogue
from amberbox.sim.robot import START_NS
from benchmarks.detectors import VARIABLE, Following, learn_model
from benchmarks.missions import Planted, live, nominal
from benchmarks.with_detectors import kept, names, score_mission, tables


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "short.model"
    learn_model(path, seconds=120.0)
    return path


def test_a_silent_topic_is_found_and_told(model: Path) -> None:
    lost = parse_disturbance("drop:odom=1@20s")
    following = Following(model)
    told = []
    for until_s, messages in live(replace(nominal(1, 40.0), disturbances=(lost,))):
        for batch in following.take(messages, START_NS + round(until_s * NS)):
            told += [found for _, found in findings_in(batch) if found is not None]
    assert "event_timing" in following.found_by(20.0)
    combined = [one for one in told if one.id == "combined.timing.sim_odom"]
    assert combined and combined[-1].trust > 0.5 and combined[-1].measured == ("sim_odom",)


def test_a_disturbance_that_no_monitor_notices_is_found_and_said(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(model))
    twice = parse_disturbance("repeat:state=3@20s")
    mission = replace(nominal(1, 40.0), disturbances=(twice,))
    found = score_mission("drawn", mission)
    assert found.shown_s is None and not found.without.stands
    assert found.found_s["event_timing"] < 10.0 and found.named_s is not None
    sound = score_mission("nominal", nominal(2, 40.0))
    assert not sound.found_s and sound.found.alarms == sum(sound.false.values())
    kept_at = tmp_path / "kept.jsonl"
    kept_at.write_text("".join(json.dumps(asdict(one)) + "\n" for one in (found, sound)) + "{torn")
    assert kept(kept_at) == [found, sound]
    text = tables(kept(kept_at), "now")
    assert "State of the code: now. Seeds 1 to 2." in text
    assert "| drawn disturbance | 1 | 0 | 1 | 1 | 0 |" in text
    assert "| disturbance: no answer | 1 of 1 |" in text
    assert "| only detectors | `repeat:state=3@20s` |" in text
    assert "| repeat | 1 | 0 | 1 | 1 | 1 |" in text


def test_an_alarm_names_a_disturbed_variable_or_a_faulty_component(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(model))
    disturbed = parse_disturbance("offset:battery.voltage=3@20s")
    weak = Planted(catalogue()["wheel_front_left_motor_weak"], 0.7, 20.0)
    for address, names_disturbed, names_faulty in (
        ("sim_battery.voltage", True, False),
        ("sim_battery.current", False, False),
        ("sim_wheels.sensors_front_left_current_1_q", False, True),
        ("sim_wheels.sensors_rear_left_current_1_q", False, False),
    ):
        item, _, variable = address.partition(".")
        reason = ScoreReason("range", item, variable)
        alarm = DetectorAlarm("guard", item, 0, 0, 2.0, 1.0, 0.1, "fleet", reason)
        mission = nominal(1, 40.0)
        assert names(alarm, replace(mission, disturbances=(disturbed,))) == names_disturbed
        assert names(alarm, replace(mission, faults=(weak,))) == names_faulty
