"""Watching with the failure modes of a folder: output and records, also after a kill."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.consult.context import load_diagnoser
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.fmea.loader import read_fmea
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from tests.cli.test_watch import folder as folder  # a fixture
from tests.cli.test_watch import record
from tests.monitoring.watcher.stand import (
    Stand,
    component,
    plan_of,
    positive,
    values_of,
    variable,
)
from tests.monitoring.watcher.stand import written as written_in

FMEA = """\
instances: {motor: [motor], room: [room]}
types:
  motor:
    tests:
      feel: {question: "Is the fan still?", outcomes: [runs, still]}
    symptoms:
      very_hot: {when: ros_temperature.data > 95}
    failure_modes:
      fan_stuck:
        rate: 1.0e-4
        symptoms: [motor/temperature/cool, very_hot]
        tests: {feel: still}
  room:
    failure_modes:
      warm: {rate: 1.0e-6, symptoms: [motor/temperature/cool]}
"""
RANDOM = """\
types:
  base: {failure_modes: {dead: {rate: 1.0e-4, symptoms: [base/m/good]}}}
  arm:
    symptoms: {backwards: {when: ros_bulk.data < 0, hold_s: 1}}
    failure_modes:
      weak: {rate: 1.0e-5, symptoms: [{symptom: arm/m/good, within_s: 1}, backwards]}
      slack: {rate: 1.0e-5, symptoms: [backwards, {symptom: extra/m/good, hold_s: 2}]}
  extra: {failure_modes: {off: {rate: 1.0e-5, symptoms: [extra/m/good]}}}
"""


@pytest.fixture
def diagnosed(folder: Path) -> Path:
    (folder / "fmea.yaml").write_text(FMEA)
    return folder


def test_a_replay_says_what_is_likely_and_what_to_do_next(
    diagnosed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(diagnosed, *[50.0] * 30, *[90.0] * 20, *[99.0] * 20, *[40.0] * 40)
    assert main(["watch", str(diagnosed), "--replay"]) == 0
    printed = capsys.readouterr()
    said = [line[24:] for line in printed.out.splitlines() if " diagnosis robot-" in line]
    assert [line.partition(": ")[2].partition(" (")[0] for line in said] == [
        "motor#fan_stuck or room#warm",
        "motor#fan_stuck",
        "healed",
    ]
    assert said[0].endswith(" %); next: Is the fan still?")
    alarms = [line for line in printed.out.splitlines() if ": alarm motor-" in line]
    assert len(alarms) == 2, "a cause alone is no line"
    assert printed.err == "" or "fmea" not in printed.err


def test_json_has_symptoms_diagnoses_and_causes(
    diagnosed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(diagnosed, *[50.0] * 30, *[99.0] * 20)
    assert main(["watch", str(diagnosed), "--replay", "--json"]) == 0
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    symptoms = {r["id"]: r["source"] for r in records if "strength" in r}
    assert symptoms == {"motor/temperature/cool": "monitor", "motor.very_hot": "condition"}
    diagnoses = [r for r in records if "hypotheses" in r]
    assert diagnoses[-1]["symptoms"] == ["motor.very_hot", "motor/temperature/cool"]
    alarms = [r for r in records if "opened_ns" in r]
    assert alarms[-1]["cause"].startswith("motor#fan_stuck (")
    assert alarms[-1]["diagnosis"] == diagnoses[-1]["id"]
    assert main(["watch", str(diagnosed), "--once"]) == 1
    assert ": motor#fan_stuck (over 99 %)" in capsys.readouterr().out.splitlines()[-1]


def test_errors_in_the_failure_modes_stop_nothing_but_the_diagnosis(
    diagnosed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(diagnosed, *[50.0] * 20, *[99.0] * 20)
    (diagnosed / "fmea.yaml").write_text(FMEA.replace("rate: 1.0e-4", "rate: -1"))
    assert main(["watch", str(diagnosed), "--replay"]) == 0
    printed = capsys.readouterr()
    assert "1 error in" in printed.err
    assert f"goes on without diagnosis; see amberbox fmea check {diagnosed}" in printed.err
    assert "alarm motor-" in printed.out
    assert "diagnosis" not in printed.out


def test_the_failure_modes_are_part_of_the_configuration(diagnosed: Path) -> None:
    """With other failure modes the watcher starts from the beginning, as with other monitors."""
    before = load_folder(diagnosed).config_hash
    (diagnosed / "fmea.yaml").write_text(FMEA + "# changed\n")
    assert load_folder(diagnosed).config_hash != before


def test_the_diagnosis_is_that_of_the_folder(diagnosed: Path) -> None:
    record(diagnosed, *[50.0] * 30, *[99.0] * 20)
    loaded = load_folder(diagnosed)
    plan, _ = load_plan(loaded)
    make, problems = load_diagnoser(loaded, plan)
    assert problems == []
    found = replay(plan, open_store(loaded.store_path), diagnoser=make)
    diagnoses = [finding for finding in found if isinstance(finding, Diagnosis)]
    assert {d.config_hash for d in diagnoses} == {plan.config_hash}
    (diagnosed / "fmea.yaml").unlink()
    assert load_diagnoser(loaded, plan) == (None, [])


@pytest.mark.parametrize("seed", range(2))
def test_killed_at_any_moment_no_diagnosis_is_lost_or_doubled(tmp_path: Path, seed: int) -> None:
    fmea, problems = read_fmea(RANDOM)
    assert fmea is not None, problems
    knowledge = Knowledge("robot", fmea, "hash")
    plan = plan_of(component("extra", positive, variable("ros_ring")))
    stand = Stand(tmp_path / "store", 70 + seed, diagnoser=partial(FaultTracker, knowledge))
    stand.watch_with_kills(80, [-3600, 3600], killed=0.05, ended=0.02, plan=plan)
    live, replayed = written_in(stand.path), stand.replayed(plan)
    assert len(values_of(live, "amberbox/diagnosis")) > 3
    assert any(s["source"] == "condition" for s in values_of(live, "amberbox/symptom"))
    assert live == replayed
