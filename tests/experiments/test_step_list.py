"""The ordered list of steps: the usual way first, and where each step goes on."""

from __future__ import annotations

from pathlib import Path

import amberbox.sim
from amberbox.experiments.profile import read_experiment
from amberbox.experiments.step_list import OrderedStep, duration_text, ordered_steps
from tests.experiments.bpmn_files import flows, line, process

SIM = Path(amberbox.sim.__file__).parent / "folder"


def steps_of(path: Path, robot: Path | None = None) -> dict[str, OrderedStep]:
    """Return the steps by the id of their element, in their order."""
    experiment, _ = read_experiment(path, robot, draft=True)
    assert experiment is not None
    return {step.id: step for step in ordered_steps(experiment)}


def test_the_list_of_a_sample_reads_in_order() -> None:
    steps = steps_of(SIM / "experiments" / "wheel_check.bpmn", SIM)
    assert list(steps) == [
        "confirm_path", "is_clear", "drive", "drive_back", "observe", "end", "safe", "ended_safe",
        "not_begun",
    ]  # fmt: skip
    assert [step.number for step in steps.values()] == list(range(1, 10))
    assert steps["is_clear"].line == (
        "Path clear? (if path_clear (yes): go to step 3; else (no): go to step 9)"
    )
    assert steps["drive"].line == (
        "robot: Drive the distance. drive_linear distance_m=distance_m speed_m_s=speed_m_s "
        "(on any error: go to step 7)"
    )
    assert steps["confirm_path"].expected.startswith("Nobody and nothing")
    assert steps["safe"].text == "all steps of Make safe"
    assert steps["end"].branches == ()


def test_timers_parallel_ways_and_hints_are_told(tmp_path: Path) -> None:
    path = tmp_path / "a.bpmn"
    path.write_text(process(
        "<startEvent id='s'/><parallelGateway id='g' name='Both'/><userTask id='a' name='A'/>"
        "<manualTask id='b'/><endEvent id='e'/><boundaryEvent id='t' attachedToRef='a' "
        "cancelActivity='false'><timerEventDefinition><timeDuration>PT90S</timeDuration>"
        "</timerEventDefinition></boundaryEvent><textAnnotation id='n'><text>Mind\nthe gap</text>"
        "</textAnnotation><association id='x' sourceRef='a' targetRef='n'/>"
        + flows("s>g", "g>a", "g>b", "a>e", "b>e", "t>b")))  # fmt: skip
    steps = steps_of(path)
    assert list(steps) == ["g", "a", "e", "b"]
    assert steps["g"].line == "Both (go to step 2; at the same time: go to step 4)"
    assert [(b.when, b.to) for b in steps["a"].branches] == [
        ("if it takes longer than 1 min 30 s, besides", 4)
    ]
    assert steps["a"].hints == ("Mind the gap",)
    assert [(b.when, b.to) for b in steps["b"].branches] == [("", 3)]


def test_steps_of_a_sub_process_are_inside(tmp_path: Path) -> None:
    path = tmp_path / "a.bpmn"
    inside = line("<userTask id='x'/>").split("<process")[1].split(">", 1)[1].split("</process")[0]
    inside = inside.replace("start", "begin").replace("begin_", "start_").replace("'end'", "'done'")
    inside = inside.replace("beginEvent", "startEvent").replace('"end"', '"done"')
    path.write_text(line(f"<subProcess id='a'>{inside}</subProcess>", "<userTask id='z'/>"))
    steps = steps_of(path)
    assert [(own, step.level) for own, step in steps.items()] == [
        ("a", 0), ("x", 1), ("done", 1), ("z", 0), ("end", 0),
    ]  # fmt: skip
    assert steps["a"].branches == ()


def test_durations_are_read_easily() -> None:
    assert duration_text(90 * 10**9) == "1 min 30 s"
    assert duration_text(int(0.25e9)) == "0.25 s"
    assert duration_text(3600 * 10**9) == "1 h"
