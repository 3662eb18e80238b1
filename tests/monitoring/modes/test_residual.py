"""The monitor of residuals: in a robot folder, in the engine, and how mistakes are reported."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.consult.folder_knowledge import plan_references
from amberbox.core.clock import NS
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Given
from amberbox.core.types import Batch, Column, ItemSchema, Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import OutputChange
from amberbox.monitoring.modes import residual as mode
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.testing.modes import assert_mode_contract, at_s, one_input

MODEL = """\
kind: equations
unknowns: [v]
known: {encoder: wheel.rate, odometer: odom.speed}
equations:
  wheel: {solve: {v: 0.1 * encoder}, component: wheel}
  odometer: {residual: odometer - v, component: odometry}
residuals:
  scale: {equations: [wheel, odometer], per: v, when: abs(v) > 0.2, over_s: 2, threshold: 0.1}
  offset: {equations: [wheel, odometer], over_s: 2, threshold: 0.05}
"""
MODE = """\
name: fits
monitor: residual
mappings:
  - mapping:
      inputs: []
      outputs:
        - output: {name: as_the_wheels, type: bool, severity: urgent}
        - output: {name: without_offset, type: bool}
        - output: {name: scale, result: size_1, type: float}
arguments:
  model: models/base.yaml
  residual: [scale, offset]
"""


def robot(folder: Path, model: str = MODEL, mode_file: str = MODE) -> Path:
    (folder / "components" / "odometry").mkdir(parents=True)
    (folder / "models").mkdir()
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text(
        "- sim: {topics: [{topic: {name: odom}}, {topic: {name: wheels}}]}\n"
    )
    (folder / "models" / "base.yaml").write_text(
        model.replace("wheel.rate", "sim_wheels.sensors_front_left_velocity_1").replace(
            "odom.speed", "sim_odom.twist_linear_x"
        )
    )
    (folder / "components" / "odometry.yaml").write_text(
        "component_name: odometry\nmodes: [odometry/fits.yaml]\n"
    )
    (folder / "components" / "odometry" / "fits.yaml").write_text(mode_file)
    return folder


def loaded(tmp_path: Path, **arguments: Any) -> Any:
    (tmp_path / "base.yaml").write_text(MODEL)
    return mode.in_folder(mode.Config("base.yaml", **arguments), tmp_path)


def test_contract(tmp_path: Path) -> None:
    configs = [loaded(tmp_path, residual="scale"), loaded(tmp_path, residual=["scale", "offset"])]
    assert_mode_contract(mode, "residual", configs=configs, examples=10)


def test_verdicts_sizes_and_reason(tmp_path: Path) -> None:
    config = loaded(tmp_path, residual="scale")
    times_s = np.arange(0, 30, 0.05)
    driven = np.where(times_s < 20, 8.0, 0.0)
    inputs = [
        one_input(
            "odom.speed",
            times_s=times_s.tolist(),
            values=np.where(times_s > 10, 1.3, 1.0) * driven * 0.1,
        ),
        one_input("wheel.rate", times_s=times_s.tolist(), values=driven),
    ]
    assert mode.reads(config) == ("odom.speed", "wheel.rate")
    found = mode.evaluate(config, inputs, at_s(1, 9, 14, 18, 25))
    assert found["consistent"].tolist() == [UNKNOWN, TRUE, FALSE, FALSE, HOLD]
    assert found["size"][1:4] == pytest.approx([0, 0.3, 0.3])
    reason = mode.reason(config, Given(inputs, int(at_s(14))))
    assert reason == "scale is off by 0.3, at most 0.1 (wheel, odometry)"
    assert mode.reason(config, Given(inputs, int(at_s(25)))) == ""


def rows(item: str, column: str, times_ns: Any, values: Any) -> Batch:
    schema = ItemSchema("sim", (Column(column, column, "float64"),))
    place = np.arange(len(times_ns))
    return Batch(item, schema, "main", 1, place, times_ns, times_ns, times_ns, {column: values})


def found_in(plan: MonitoringPlan, cuts_s: Sequence[float]) -> list[Any]:
    """Return what an engine finds in a drive that is cut at some times; odometry becomes wrong."""
    engine = Engine(plan)
    engine.begin(0)
    fast, slow = (np.arange(1, 40 * NS, step) for step in (NS // 50, NS // 17))
    rate = 10 * np.sin(0.3 * fast / NS)
    speed = np.sin(0.3 * slow / NS) * np.where(slow > 15 * NS, 1.3, 1.0)
    found: list[Any] = []
    before_ns = 0
    for until_s in (*cuts_s, 40.0):
        until_ns = round(until_s * NS)
        for item, column, times_ns, values in (
            ("sim_wheels", "sensors_front_left_velocity_1", fast, rate),
            ("sim_odom", "twist_linear_x", slow, speed),
        ):
            part = (times_ns > before_ns) & (times_ns <= until_ns)
            engine.feed(rows(item, column, times_ns[part], values[part]))
        found += engine.advance(until_ns)
        before_ns = until_ns
    return [one for one in found if not isinstance(one, OutputChange)]


def test_the_engine_finds_the_same_however_a_record_is_cut(tmp_path: Path) -> None:
    plan, problems = load_plan(load_folder(robot(tmp_path)))
    assert not [str(p) for p in problems if p.is_error]
    whole = found_in(plan, [])
    statuses = [one for one in whole if isinstance(one, Status) and one.mode == "fits"]
    levels = list(dict.fromkeys(one.level for one in statuses))
    assert levels == ["unknown", "ok", "error"]
    first_ns = min(one.since_ns for one in statuses if one.level == "error")
    assert 16 * NS < first_ns < 18 * NS
    for cuts_s in ([0.3 * k for k in range(1, 130)], [7.01, 15.49, 33.3], range(1, 40)):
        assert found_in(plan, list(cuts_s)) == whole


def test_a_step_of_the_clock_begins_anew(tmp_path: Path) -> None:
    plan, _ = load_plan(load_folder(robot(tmp_path)))
    engine = Engine(plan)
    engine.begin(0)
    times_ns = np.arange(1, 10 * NS, NS // 50)
    for start_ns in (0, 3600 * NS):
        if start_ns:
            engine.begin(start_ns)
        for item, column, factor in (("sim_wheels", "sensors_front_left_velocity_1", 10.0),
                                     ("sim_odom", "twist_linear_x", 1.3)):  # fmt: skip
            values = np.full(len(times_ns), factor * 0.5)
            engine.feed(rows(item, column, times_ns + start_ns, values))
        levels = {
            (one.measured_ns - start_ns) // NS: one.level
            for one in engine.advance(start_ns + 9 * NS)
            if isinstance(one, Status) and one.mode == "fits"
        }
        assert levels[1] == "unknown" and levels[8] == "error"


def test_the_size_of_a_symptom_is_that_of_its_residual(tmp_path: Path) -> None:
    plan, _ = load_plan(load_folder(robot(tmp_path)))
    known = plan_references(plan)
    assert known.measures is not None
    measure = known.measures["odometry/fits/as_the_wheels"]
    assert measure.expression.addresses() == ("odometry/fits/scale",)
    assert "odometry/fits/without_offset" not in known.measures  # no output shows its size


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ("model.yaml", "cannot be read"),
        ("[scale, offset]|[scal]", "there is no residual 'scal'; did you mean 'scale'"),
        ("[scale, offset]|[scale, scale]", "names one twice"),
        ("threshold: 0.1|least: 20", "the residual 'scale' of models/base.yaml has no threshold"),
        ("solve: {v|solve: {w", "there is no variable 'w'"),
        ("encoder: wheel.rate|encoder: sim_wheels.nothing", "sim_wheels has no variable"),
    ],
)
def test_mistakes_are_named_and_the_mode_is_unknown(
    tmp_path: Path, change: str, wanted: str
) -> None:
    old, _, new = change.partition("|")
    model, mode_file = MODEL.replace(old, new), MODE.replace(old, new)
    if old == "model.yaml":
        mode_file = MODE.replace("base.yaml", "bas.yaml")
    plan, problems = load_plan(load_folder(robot(tmp_path, model, mode_file)))
    assert wanted in "\n".join(str(p) for p in problems if p.is_error)
    ((_, planned),) = plan.modes()
    assert planned.problem
