"""``amberbox run`` with a learnt model: its alarms are in the diagnosis, live and afterwards."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import amberbox
from amberbox.agent.detect import ALARM_ITEM
from amberbox.blackbox.journal.channels import DIAGNOSIS
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.diagnosis.tracker import FaultTracker
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.record_evaluation import replay
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.monitoring.watcher.stand import line_of, values_of, written

UNITS = ("front_left", "front_right", "rear_left", "rear_right")
SIM = "- sim: {{seed: {seed}, speed: {speed}, topics: [{{topic: {{name: wheels}}}}]{more}}}\n"
MODE = """\
name: supplied
monitor: range
mappings:
  - mapping:
      inputs: [sim_wheels.{address}]
      outputs: [{{output: {{name: supplied, type: bool, expected: true}}}}]
arguments: {{min: 5, max: 100}}
"""
FMEA = """\
other: {share: 0.5, probability: 2.0e-5, detects: 0.02}
types:
"""
FAILURE_MODES = """\
  wheel_{unit}:
    failure_modes:
      no_supply: {{probability: 1.0e-2, symptoms: [wheel_{unit}/supplied/supplied]}}
"""
CONFLICT = "one of wheel_front_left"


def address_of(unit: str) -> str:
    return f"sensors_{unit}_voltage_bus"


def robot(path: Path, *, speed: str, more: str, seed: int) -> Path:
    path.mkdir()
    (path / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    (path / "black_box.yaml").write_text(SIM.format(seed=seed, speed=speed, more=more))
    return path


def watched(folder: Path, model: Path) -> None:
    """Write a wide limit and a failure mode of each wheel unit, and the model, into a folder."""
    with (folder / "robot.yaml").open("a") as file:
        file.write(f"detection: {{model: {model}}}\n")
    for unit in UNITS:
        modes = folder / "components" / f"wheel_{unit}"
        modes.mkdir(parents=True)
        (modes / "supplied.yaml").write_text(MODE.format(address=address_of(unit)))
        text = f"component_name: wheel_{unit}\nmodes: [wheel_{unit}/supplied.yaml]\n"
        modes.with_suffix(".yaml").write_text(text)
    (folder / "fmea.yaml").write_text(FMEA + "".join(FAILURE_MODES.format(unit=u) for u in UNITS))


def learnt(path: Path) -> Path:
    """Learn on four nominal minutes that the four units have the same supply."""
    nominal = robot(path / "nominal", speed="max", more=", duration_s: 240", seed=3)
    members = "".join(f"        {u}: [sim_wheels.{address_of(u)}]\n" for u in UNITS)
    options, model = path / "detectors.yaml", path / "r1.model"
    options.write_text(f"redundant:\n  groups:\n    supply:\n      members:\n{members}")
    assert main(["record", str(nominal), "--quiet"]) == 0
    words = ["-o", str(model), "--detectors", "redundant", "--options", str(options)]
    assert main(["learn", str(nominal), *words]) == 0
    return model


def test_the_odd_one_out_is_a_conflict_of_the_diagnosis(tmp_path: Path) -> None:
    offset = "kind: offset, item: wheels, variable: sensors.front_left.voltage_bus"
    more = f", disturbances: [{{{offset}, amount: 2, at_s: 8}}]"
    folder = robot(tmp_path / "r1", speed="1", more=more, seed=4)
    watched(folder, learnt(tmp_path))
    assert main(["check", str(folder)]) == 0

    store = folder / "store"

    def rows_of(item: str) -> int:
        return sum(each.rows for each in amberbox.open(store).items() if each.name == item)

    def diagnosed() -> list[dict[str, object]]:
        return values_of(written(store), DIAGNOSIS)

    box = subprocess.Popen([sys.executable, "-m", "amberbox", "run", "--quiet", str(folder)])
    try:
        wait_until((store / "lock.watch").exists, "the watcher runs")
        wait_until((store / "lock.detect").exists, "the detectors run")
        wait_until(lambda: rows_of("detector_redundant") > 0, "there are scores")
        wait_until(lambda: rows_of(ALARM_ITEM) > 0, "there is an alarm")
        wait_until(lambda: CONFLICT in str(diagnosed()), "the conflict is in a diagnosis")
    finally:
        box.terminate()  # killed, it would leave its recorder running
        status = box.wait(PATIENCE_S)
    assert status == 0
    live = diagnosed()
    assert any("wheel_front_left#no_supply" in str(one) for one in live if CONFLICT in str(one))
    loaded = load_folder(folder)
    plan, _ = load_plan(loaded)
    knowledge, _ = load_knowledge(loaded, plan)
    assert knowledge is not None
    found = replay(plan, open_store(store), diagnoser=lambda: FaultTracker(knowledge))
    again = values_of([line_of(one) for one in found], DIAGNOSIS)
    assert again[: len(live)] == live  # the recorder has ended after the watcher
