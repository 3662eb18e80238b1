"""Translate mode files of the predecessor's robots: function names and arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from amberbox.core.errors import Problem
from amberbox.core.yaml_nodes import Node
from amberbox.monitoring.component_files import MonitorFunctions, function_of

ROBOT_NUMBER = "ROPODID"  # placeholder in their inputs: 001 of ropod_001

Keys: TypeAlias = dict[str, Node]


@dataclass(frozen=True)
class LegacyMonitor:
    """A monitor of the predecessor: the function that replaces it, and how its keys are changed.

    ``renamed`` gives arguments another name; ``dropped`` are those that become inputs, or have no
    effect. ``fixed`` are arguments that its code had. ``mappings`` rewrites each mapping.
    """

    monitor: str
    does: str
    renamed: Mapping[str, str] = field(default_factory=dict)
    dropped: Sequence[str] = ()
    fixed: Mapping[str, Any] = field(default_factory=dict)
    arguments: Callable[[Keys], Mapping[str, Any]] = lambda keys: {}
    mappings: Callable[[Node, Keys], list[Node]] = lambda node, keys: [node]
    refuses: Callable[[str], str] = lambda text: ""
    """Returns why an input of theirs cannot be one of ours."""


def translate_mode_file(
    name: str, node: Node, functions: MonitorFunctions, robot: str, problems: list[Problem]
) -> Node:
    """Return a mode file in the present format; one already in it is returned unchanged."""
    node = _with_number(node, robot.rpartition("_")[2])
    keys = node.mapping or {}
    entry = LEGACY_MONITORS.get(name)
    if entry is None or "monitor" in keys or entry.monitor not in functions.modes:
        return node
    given = keys.get("arguments")
    arguments = (given.mapping if given is not None else None) or {}
    theirs = {*entry.renamed, *entry.dropped} & arguments.keys()
    if function_of(name, functions.modes) is not None and not theirs:
        return node
    note = f"read as the monitor '{entry.monitor}': {entry.does}"
    problems.append(keys.get("name", node).problem("name", note, is_error=False))
    problems.extend(_objections(keys.get("mappings", node), entry))
    return _as_ours(node, keys, dict(arguments), entry)


def _objections(mappings: Node, entry: LegacyMonitor) -> Iterator[Problem]:
    for index, mapping in enumerate(mappings.items or ()):
        keys = mapping.mapping or {}
        inputs = (keys.get("mapping", mapping).mapping or {}).get("inputs", mapping)
        for node in inputs.items or ():
            what = entry.refuses(node.text)
            if what:
                yield node.problem(f"mappings[{index}].inputs", what)


def _as_ours(node: Node, keys: Keys, arguments: Keys, entry: LegacyMonitor) -> Node:
    place = keys.get("arguments", node)
    kept = {
        entry.renamed.get(key, key): value
        for key, value in arguments.items()
        if key not in entry.dropped
    }
    added = {**entry.fixed, **entry.arguments(arguments)}
    kept |= {key: as_node(value, place) for key, value in added.items()}
    mappings = keys.get("mappings", node)
    entries = [new for old in mappings.items or () for new in entry.mappings(old, arguments)]
    return replace(
        node,
        value=keys
        | {
            "monitor": as_node(entry.monitor, keys.get("name", node)),
            "arguments": replace(place, value=kept),
            "mappings": replace(mappings, value=tuple(entries)),
        },
    )


def as_node(value: Any, place: Node) -> Node:
    """Convert plain values to nodes, as if they had been written at a place in a file."""
    if isinstance(value, Mapping):
        inner: Any = {key: as_node(entry, place) for key, entry in value.items()}
    elif isinstance(value, list | tuple):
        inner = tuple(as_node(entry, place) for entry in value)
    else:
        inner = value
    return Node(place.file, place.line, inner, "" if inner is not value else str(value))


def _with_number(node: Node, number: str) -> Node:
    """Put the robot's number in the inputs of all mappings."""
    keys = node.mapping
    if keys is not None:
        return replace(node, value={k: _with_number(inner, number) for k, inner in keys.items()})
    if node.items is not None:
        return replace(node, value=tuple(_with_number(inner, number) for inner in node.items))
    if ROBOT_NUMBER not in node.text:
        return node
    text = node.text.replace(ROBOT_NUMBER, number)
    return replace(node, value=text, text=text)


def _changed(mapping: Node, change: Callable[[Keys], Mapping[str, Any]]) -> Node:
    """Change keys of a mapping, wrapped in ``mapping:`` or not."""
    keys = mapping.mapping or {}
    inner = keys.get("mapping")
    if inner is not None and inner.mapping is not None:
        return replace(mapping, value={"mapping": _changed(inner, change)})
    new = {key: as_node_kept(value, mapping) for key, value in change(keys).items()}
    return replace(mapping, value=keys | new)


def as_node_kept(value: Any, place: Node) -> Node:
    """Return a node unchanged, and plain values as nodes."""
    return value if isinstance(value, Node) else as_node(value, place)


def _number(arguments: Keys, key: str, default: float) -> float:
    value = arguments[key].value if key in arguments else default
    return value if isinstance(value, int | float) else default


def _wheels(text: str, arguments: Keys) -> list[str]:
    count = round(_number(arguments, "number_of_wheels", 4))
    return [text.replace("*", str(wheel), 1) for wheel in range(count)]


def _of_pattern(mapping: Node, arguments: Keys) -> list[Node]:
    """Use the variables of all wheels as inputs."""
    pattern = arguments.get("variable_name_pattern")
    if pattern is None:
        return [mapping]
    return [_changed(mapping, lambda keys: {"inputs": _wheels(pattern.text, arguments)})]


def _each_wheel(mapping: Node, arguments: Keys) -> list[Node]:
    """Make a mapping for each wheel, its outputs with the number of the wheel."""

    def of(wheel: int) -> Callable[[Keys], Mapping[str, Any]]:
        def change(keys: Keys) -> Mapping[str, Any]:
            inputs = keys["inputs"].items or () if "inputs" in keys else ()
            outputs = keys["outputs"].items or () if "outputs" in keys else ()
            return {
                "inputs": [_wheels(entry.text, arguments)[wheel] for entry in inputs],
                "outputs": replace(
                    keys.get("outputs", mapping),
                    value=tuple(_numbered(output, wheel + 1) for output in outputs),
                ),
            }

        return change

    return [_changed(mapping, of(wheel)) for wheel in range(len(_wheels("*", arguments)))]


def _numbered(output: Node, number: int) -> Node:
    keys = output.mapping or {}
    inner = keys.get("output")
    if inner is not None:
        return replace(output, value={"output": _numbered(inner, number)})
    if "name" not in keys:
        return output
    name = f"{keys['name'].text.strip()}_{number}"
    return replace(output, value=keys | {"name": as_node(name, keys["name"])})


def _covariance(mapping: Node, arguments: Keys) -> list[Node]:
    """Use x, y and heading of a 6 x 6 covariance as inputs."""
    variable = arguments.get("bb_variable_name")
    if variable is None:
        return [mapping]
    names = [f"{variable.text}/{place}" for place in (0, 7, 35)]
    return [_changed(mapping, lambda keys: {"inputs": names})]


def _only(*inputs: str) -> Callable[[Node, Keys], list[Node]]:
    """Return a change that sets these inputs for mappings without inputs."""

    def change(keys: Keys) -> Mapping[str, Any]:
        given = keys["inputs"].items if "inputs" in keys else ()
        return {} if given else {"inputs": list(inputs)}

    return lambda mapping, arguments: [_changed(mapping, change)]


def _global_names(mapping: Node, arguments: Keys) -> list[Node]:
    """Return mappings whose ROS names have their leading slash."""

    def change(keys: Keys) -> Mapping[str, Any]:
        entries = (keys["inputs"].items or ()) if "inputs" in keys else ()
        return {"inputs": [f"/{entry.text.lstrip('/')}" for entry in entries]}

    return [_changed(mapping, change)]


def _no_container(text: str) -> str:
    what = f"'{text}' names an image: write the name of its container"
    return what if ":" in text else ""


def _kinematics(arguments: Keys) -> Mapping[str, Any]:
    """Write the pivot's expected velocity as an expression of the wheels' velocities."""
    radius = _number(arguments, "wheel_diameter", 0.073) / 2
    distance = _number(arguments, "inter_wheel_distance", 0.0893)
    return {"formula": f"-{radius:.6g} * (input_1 + input_2) / {distance:.6g}", "window": 1}


_PATTERN = ("variable_name_pattern", "number_of_wheels")

# by the name of the mode
LEGACY_MONITORS: Mapping[str, LegacyMonitor] = {
    "battery_functional_monitor": LegacyMonitor(
        "battery",
        "the mean of the wheels' bus voltages between lowest and highest_voltage",
        dropped=_PATTERN,
        mappings=_of_pattern,
    ),
    "e_stop_functional_monitor": LegacyMonitor(
        "state_bits",
        "bit 2 of the wheels' status words, which is not set when all is well",
        dropped=_PATTERN,
        fixed={"bits": {"e_stop_pressed": {"bit": 2, "nominal": False}}},
        mappings=_of_pattern,
    ),
    "smart_wheel_status_monitor": LegacyMonitor(
        "state_bits",
        "bit 0 of each wheel's status word",
        dropped=_PATTERN,
        fixed={"bits": {"enabled": 0}},
        mappings=_of_pattern,
    ),
    "pressure_functional_monitor": LegacyMonitor(
        "redundancy",
        "the barometers of the wheels against each other; median_window_size in seconds",
        renamed={"fault_threshold": "threshold", "median_window_size": "window"},
        dropped=_PATTERN,
        mappings=_of_pattern,
    ),
    "diff_drive_kinematics_monitor": LegacyMonitor(
        "redundancy",
        "the pivot's velocity against the wheels', for each wheel with outputs of its own",
        renamed={"pivot_velocity_threshold": "threshold"},
        dropped=("number_of_wheels", "wheel_diameter", "inter_wheel_distance"),
        arguments=_kinematics,
        mappings=_each_wheel,
    ),
    "localisation_functional_monitor": LegacyMonitor(
        "localisation",
        "the variances of x, y and heading in the covariance",
        dropped=("bb_variable_name",),
        mappings=_covariance,
    ),
    "wifi_functional_monitor": LegacyMonitor(
        "network", "quality and strength of the interface wlan0", mappings=_only("wifi wlan0")
    ),
    "docker_container_monitor": LegacyMonitor(
        "service", "containers that run", fixed={"kind": "container"}, refuses=_no_container
    ),
    "ros_master_monitor": LegacyMonitor(
        "service",
        "the master that ROS_MASTER_URI names",
        fixed={"kind": "ros_master"},
        mappings=_only("default"),
    ),
    "ros_node_monitor": LegacyMonitor(
        "service", "nodes that answer", fixed={"kind": "ros_node"}, mappings=_global_names
    ),
    "ros_topic_monitor": LegacyMonitor(
        "service",
        "topics that somebody publishes",
        fixed={"kind": "ros_topic"},
        mappings=_global_names,
    ),
    "systemd_services_active_monitor": LegacyMonitor(
        "service", "units that are active", fixed={"kind": "unit"}
    ),
}
