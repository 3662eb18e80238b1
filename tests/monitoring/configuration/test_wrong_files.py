"""Any content of component and mode files gives a plan, and problems with lines."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.monitoring.configuration.folders import plan_of

COMPONENT = """\
component_name: laser
description: Front laser
modes: [modes/device.yaml, modes/range.yaml]
dependencies: [laser, power, roscore]
dependency_monitors:
    heartbeat: {roscore: laser/device/works}
    functional: {power: none}
recovery_actions: [restart]
part_of: laser
policy: any
"""
RANGE = """\
name: odom_range_monitor
mappings:
    - mapping:
        inputs: [ros_odom.pose_pose_position_x, ros_own_data/sensors/0/x]
        outputs:
            - output: {name: a, type: bool, expected: true, for: 1s}
            - output:
                name: b
                type: float
                expected: {min: 1, max: 2}
                flapping: {changes: 3}
arguments: {max: 3}
states: {off: not a}
stale_after: 3
"""
DEVICE = """\
name: device
mappings:
    - {inputs: [/dev/laser], outputs: [{name: works, type: bool}]}
"""
WORDS = (
    "",
    "~",
    "[]",
    "{}",
    "[[]]",
    "3",
    "true",
    "-",
    "a: b",
    "!!x y",
    "'",
    "*",
    "\t",
    "name",
    ": ",
)


@st.composite
def damaged(draw: st.DrawFn, text: str) -> str:
    """Cut, double or replace parts of a text."""
    for _ in range(draw(st.integers(0, 3))):
        words = text.split(" ")
        place = draw(st.integers(0, len(words) - 1))
        words[place : place + draw(st.integers(0, 2))] = [draw(st.sampled_from(WORDS))]
        text = " ".join(words)
    lines = text.split("\n")
    if draw(st.booleans()):
        del lines[draw(st.integers(0, len(lines) - 1))]
    return "\n".join(lines)


@settings(max_examples=30)
@given(damaged(COMPONENT), damaged(RANGE), damaged(DEVICE), damaged("laser: {monitor: a/b}\n"))
def test_nothing_stops_it(component: str, range_: str, device: str, recovery: str) -> None:
    files = {
        "laser.yaml": component,
        "modes/range.yaml": range_,
        "modes/device.yaml": device,
        "recovery_config.yaml": recovery,
    }
    with TemporaryDirectory() as folder:
        plan, problems = plan_of(Path(folder), files)
        texts = {path.name: path.read_text() for path in Path(folder).rglob("*.yaml")}
    for problem in problems:
        name = problem.file.rpartition("/")[2]
        assert name == "components" or 1 <= problem.line <= texts[name].count("\n") + 2
        assert problem.what
    for _, mode in plan.modes():
        assert mode.problem or (mode.module is not None and mode.config is not None)
    assert plan.probes() is not None
    wrong = any(problem.is_error for problem in problems)
    assert wrong or not any(mode.problem for _, mode in plan.modes()), "what cannot run is told"
