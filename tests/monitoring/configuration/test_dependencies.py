"""Dependencies of components, the monitors that give their state, and their errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from amberbox.core.errors import Problem
from amberbox.core.needs import Needs, all_of, any_of, at_least
from amberbox.monitoring.plan import DependencyPlan, MonitoringPlan
from tests.monitoring.configuration.folders import component, errors, notes, plan_of

NODES = """\
name: ros_node_monitor
monitor: service
arguments: {kind: ros_node}
mappings:
  - {inputs: [/a], outputs: [{name: planner, type: bool}]}
  - {inputs: [/b], outputs: [{name: floor_detection, type: bool}]}
"""
MASTER = """\
name: ros_master_monitor
monitor: service
arguments: {kind: ros_master}
mappings:
  - {inputs: [default], outputs: [{name: status, type: bool}]}
"""
ROS = {
    "ros.yaml": "component_name: ros\nmodes: [ros/nodes.yaml, ros/master.yaml]\n",
    "ros/nodes.yaml": NODES,
    "ros/master.yaml": MASTER,
}


def _edges(
    path: Path, text: str, others: Sequence[str] = ()
) -> tuple[Sequence[DependencyPlan], list[Problem]]:
    """Load a component ``x`` beside ``ros`` and others without monitors."""
    files = {f"{name}.yaml": f"component_name: {name}\n" for name in others}
    plan, problems = plan_of(path, ROS | files | {"x.yaml": f"component_name: x\n{text}"})
    return component(plan, "x").dependencies, problems


def _of(kind: str, name: str, monitor: str) -> str:
    return f"dependencies: [{name}]\ndependency_monitors: {{{kind}: {{{name}: {monitor}}}}}\n"


def test_a_component(tmp_path: Path) -> None:
    (edge,), problems = _edges(tmp_path, "dependencies: [ros]\n")
    assert problems == []
    assert edge == DependencyPlan("ros", "", "ros")


@pytest.mark.parametrize(
    ("monitor", "mode", "output"),
    [
        ("ros/ros_node_monitor", "ros_node_monitor", "planner"),
        ("ros/nodes", "ros_node_monitor", "planner"),
        ("ros/nodes/floor_detection", "ros_node_monitor", "floor_detection"),
        ("ros/ros_master_monitor", "ros_master_monitor", ""),
    ],
)
def test_a_monitor_speaks_for_it(tmp_path: Path, monitor: str, mode: str, output: str) -> None:
    (edge,), problems = _edges(tmp_path, _of("functional", "planner", monitor), ["planner"])
    assert problems == []
    assert edge == DependencyPlan("planner", "functional", "ros", mode, output)


def test_a_monitor_speaks_for_what_is_no_component(tmp_path: Path) -> None:
    (edge,), problems = _edges(tmp_path, _of("heartbeat", "roscore", "ros/ros_master_monitor"))
    assert edge == DependencyPlan("roscore", "heartbeat", "ros", "ros_master_monitor")
    assert errors(problems) == []
    assert notes(problems) == [
        "x.yaml:3: dependency_monitors.heartbeat.roscore: there is no component 'roscore': "
        "ros/ros_master_monitor speaks for it; did you mean 'ros'?"
    ]


def test_its_own_monitor_speaks_as_a_whole(tmp_path: Path) -> None:
    (edge,), problems = _edges(tmp_path, _of("functional", "ros", "ros/ros_node_monitor"))
    assert problems == []
    assert edge == DependencyPlan("ros", "functional", "ros", "ros_node_monitor")


def test_both_levels(tmp_path: Path) -> None:
    text = """\
dependencies: [planner]
dependency_monitors:
    heartbeat: {planner: ros/ros_master_monitor}
    functional: {planner: ros/ros_node_monitor}
"""
    edges, problems = _edges(tmp_path, text, ["planner"])
    assert problems == []
    assert [(edge.kind, edge.output) for edge in edges] == [
        ("heartbeat", ""),
        ("functional", "planner"),
    ]


def test_nobody(tmp_path: Path) -> None:
    (edge,), problems = _edges(tmp_path, _of("functional", "ros", "none"))
    assert problems == []
    assert edge == DependencyPlan("ros", "functional", "ros", judged=False)


@pytest.mark.parametrize(
    ("text", "line", "what", "component"),
    [
        ("dependencies: [rso]\n", 2, "there is no component 'rso'; did you mean 'ros'?", None),
        (_of("functional", "floor", "ros/ros_node_monitor"), 3,
         "ros/ros_node_monitor has no output 'floor'", "floor"),
        (_of("functional", "floor_detector", "ros/ros_node_monitor"), 3,
         "ros/ros_node_monitor has no output 'floor_detector'; "
         "did you mean 'floor_detection'?", None),
        (_of("functional", "planner", "rso/nodes"), 3,
         "there is no component 'rso'; did you mean 'ros'?", None),
        (_of("functional", "planner", "ros/knots"), 3, "ros has no mode 'knots'", None),
        (_of("functional", "planner", "ros/nodes/plan"), 3,
         "ros/nodes has no output 'plan'; did you mean 'planner'?", None),
        (_of("functional", "planner", "nodes"), 3,
         "'nodes' is no monitor: write COMPONENT/MODE, or none", None),
    ],
)  # fmt: skip
def test_what_dangles(
    tmp_path: Path, text: str, line: int, what: str, component: str | None
) -> None:
    (edge,), problems = _edges(tmp_path, text, ["floor"])
    (error,) = errors(problems)
    assert error.startswith(f"x.yaml:{line}: ")
    assert error.split(": ", 2)[2].startswith(what)
    assert (edge.component, edge.mode) == (component, ""), "the component itself, or nothing"
    assert bool(edge.problem) == (component is None)


def test_a_monitor_of_what_is_no_dependency(tmp_path: Path) -> None:
    text = "dependencies: [ros]\ndependency_monitors: {functional: {rso: ros/nodes}}\n"
    _, problems = _edges(tmp_path, text)
    assert errors(problems) == [
        "x.yaml:3: dependency_monitors.functional.rso: 'rso' is not among the dependencies; "
        "did you mean 'ros'?"
    ]


def _circles(path: Path, needs: dict[str, str]) -> tuple[MonitoringPlan, list[Problem]]:
    files = {
        f"{name}.yaml": f"component_name: {name}\ndependencies: [{', '.join(of)}]\n"
        for name, of in needs.items()
    }
    return plan_of(path, files)


def test_circles(tmp_path: Path) -> None:
    plan, problems = _circles(tmp_path, {"a": "b", "b": "cd", "c": "a", "d": "d", "e": "a"})
    assert errors(problems) == [
        "c.yaml:2: dependencies: needs itself: a -> b -> c -> a",
        "d.yaml:2: dependencies: needs itself: d -> d",
    ]
    edges = {(c.id, edge.name): edge.component for c in plan.components for edge in c.dependencies}
    assert edges == {
        ("a", "b"): "b",
        ("b", "c"): "c",
        ("b", "d"): "d",
        ("c", "a"): None,
        ("d", "d"): None,
        ("e", "a"): "a",
    }


def test_no_circles(tmp_path: Path) -> None:
    _, problems = _circles(tmp_path, {"a": "bc", "b": "d", "c": "d", "d": ""})
    assert problems == []


def test_a_circle_that_a_mode_judges_is_told_and_stays(tmp_path: Path) -> None:
    text = "component_name: planner\ndependencies: [x]\n"
    files = ROS | {"planner.yaml": text}
    files["x.yaml"] = f"component_name: x\n{_of('functional', 'planner', 'ros/nodes')}"
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == ["x.yaml:2: dependencies: needs itself: planner -> x -> planner"]
    (edge,) = component(plan, "x").dependencies
    assert (edge.component, edge.output, edge.problem) == ("ros", "planner", "")


def _needing(path: Path, text: str) -> tuple[MonitoringPlan, list[Problem]]:
    """Load a component ``x`` that needs something beside ``ros``, a, b, c and d."""
    files = {f"{name}.yaml": f"component_name: {name}\n" for name in "abcd"}
    return plan_of(path, ROS | files | {"x.yaml": f"component_name: x\ndependencies:{text}\n"})


@pytest.mark.parametrize(
    ("text", "names", "needs"),
    [
        (" [a, b, a]", "ab", None),
        (" {all: [b, a]}", "ba", None),
        (" {any: [a, b]}", "ab", any_of("a", "b")),
        (" {at_least: 2, of: [a, b, c]}", "abc", at_least(2, "a", "b", "c")),
        (" [a, {any: [b, {all: [c, a]}]}]", "abc", all_of("a", any_of("b", all_of("c", "a")))),
        ("\n  any:\n    - a\n    - {at_least: 1, of: [d, c]}", "adc",
         any_of("a", at_least(1, "d", "c"))),
        (" {any: [a]}", "a", None),
        (" []", "", None),
    ],
)  # fmt: skip
def test_what_is_needed_may_be_nested(
    tmp_path: Path, text: str, names: str, needs: Needs | None
) -> None:
    plan, problems = _needing(tmp_path, text)
    assert problems == []
    x = component(plan, "x")
    assert [(edge.name, edge.component) for edge in x.dependencies] == [(n, n) for n in names]
    assert x.needs == needs


def test_monitors_speak_for_what_one_can_do_without(tmp_path: Path) -> None:
    text = """ {any: [planner, {all: [ros, a]}]}
dependency_monitors:
    heartbeat: {planner: ros/ros_master_monitor}
    functional: {planner: ros/nodes, ros: ros/nodes/floor_detection, a: none}"""
    plan, problems = _needing(tmp_path, text)
    assert errors(problems) == []
    x = component(plan, "x")
    assert x.needs == any_of("planner", all_of("ros", "a"))
    assert [(e.name, e.kind, e.mode, e.output, e.judged) for e in x.dependencies] == [
        ("planner", "heartbeat", "ros_master_monitor", "", True),
        ("planner", "functional", "ros_node_monitor", "planner", True),
        ("ros", "functional", "ros_node_monitor", "floor_detection", True),
        ("a", "functional", "", "", False),
    ]


def test_what_one_can_do_without_has_to_be_there(tmp_path: Path) -> None:
    plan, problems = _needing(tmp_path, "\n  - a\n  - any:\n      - b\n      - rso")
    assert errors(problems) == [
        "x.yaml:6: dependencies: there is no component 'rso'; did you mean 'ros'?"
    ]
    assert component(plan, "x").dependencies[2].problem


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("\n  any: []", "3: dependencies.any: nothing is named: a gate without input"),
        ("\n  at_least: 3\n  of: [a, b]", "3: dependencies.at_least: 3 of 2 can never be up"),
        ("\n  at_leats: 1\n  of: [a, b]",
         "3: dependencies: unknown key 'at_leats'; did you mean 'at_least'?"),
        ("\n  any:\n    - a\n    - a", "5: dependencies.any[1]: 'a' comes twice"),
        (" [a, [b]]", "2: dependencies[1]: expected a name, got a list"),
        (" a", "2: dependencies: expected a list, got text 'a'"),
        ("", "2: dependencies: expected what is needed, got nothing"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_needs(tmp_path: Path, text: str, error: str) -> None:
    plan, problems = _needing(tmp_path, text)
    assert errors(problems) == [f"x.yaml:{error}"]
    (broken,) = component(plan, "x").modes
    assert broken.problem.startswith(error.partition(": ")[2]), "its status is unknown"


def test_a_circle_through_what_one_can_do_without(tmp_path: Path) -> None:
    files = {
        "a.yaml": "component_name: a\ndependencies: {any: [b, c]}\n",
        "b.yaml": "component_name: b\ndependencies: [a]\n",
        "c.yaml": "component_name: c\n",
    }
    plan, problems = plan_of(tmp_path, files)
    assert errors(problems) == ["b.yaml:2: dependencies: needs itself: a -> b -> a"]
    assert component(plan, "a").needs == any_of("b", "c")


def test_parts(tmp_path: Path) -> None:
    files = {
        "a.yaml": "component_name: a\npart_of: b\n",
        "b.yaml": "component_name: b\npart_of: a\n",
        "c.yaml": "component_name: c\npart_of: a\n",
        "d.yaml": "component_name: d\npart_of: cc\n",
    }
    _, problems = plan_of(tmp_path, files)
    assert errors(problems) == [
        "a.yaml:2: part_of: a is a part of itself",
        "b.yaml:2: part_of: b is a part of itself",
        "d.yaml:2: part_of: there is no component 'cc'; did you mean 'c'?",
    ]


def test_recovery(tmp_path: Path) -> None:
    recovery = """\
ros:
    monitor: ros/nodes
    monitored_parameter: planner
    restart: ros.service
    component_type: systemd
rso: {monitor: ros/nodes, monitored_parameter: planning, restart: ros.service}
x: {monitor: ros/knots, restrat: x}
"""
    plan, problems = plan_of(tmp_path, ROS | {"sub/recovery_config.yaml": recovery})
    assert errors(problems) == [
        "sub/recovery_config.yaml:6: rso: there is no component 'rso'; did you mean 'ros'?",
        "sub/recovery_config.yaml:6: rso.monitored_parameter: ros/nodes has no output "
        "'planning'; did you mean 'planner'?",
        "sub/recovery_config.yaml:7: x: unknown key 'restrat'; did you mean 'restart'?",
    ]
    assert "nothing carries them out by itself" in notes(problems)[0]
    assert component(plan, "ros").recovery_actions == (
        "restart ros.service (systemd) when ros/nodes/planner tells a fault",
    )
