"""What was seen of a robot: its graph, the rates of its topics, what its nodes reported."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from amberbox.agent.commissioning.listening import ObservedStream, ObservingSink, listen
from amberbox.agent.commissioning.rate import LearnedRate, learn_rate
from amberbox.blackbox.columns.unroll import unroller
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock, read_blocks
from amberbox.blackbox.robot_folder.folder import SOURCES
from amberbox.core.clock import NS
from amberbox.core.config import raise_errors
from amberbox.core.errors import AmberboxError, Problem, UsageError
from amberbox.core.plugins import get
from amberbox.core.robot_graph import RobotGraph
from amberbox.core.types import Rows
from amberbox.core.yaml_nodes import parse_yaml

# types by their full names, with the levels and statuses that are bad news in them
LOG_TYPES = {"rosgraph_msgs/msg/Log": 8, "rcl_interfaces/msg/Log": 40}
DIAGNOSTIC_TYPES = ("diagnostic_msgs/msg/DiagnosticArray",)
# events of services whose answer says by ``success`` whether the call failed
CALL_TYPES = frozenset(
    f"{service}_Event"
    for service in (
        "std_srvs/srv/Trigger", "std_srvs/srv/SetBool", "lifecycle_msgs/srv/ChangeState",
        "nav2_msgs/srv/ManageLifecycleNodes",
    )
)  # fmt: skip
GOAL_TYPES = {"actionlib_msgs/msg/GoalStatusArray": (4, 5), "action_msgs/msg/GoalStatusArray": (6,)}


def full_type(name: str) -> str:
    """Return ``nav_msgs/msg/Odometry`` for ``nav_msgs/Odometry``, and other names as they are."""
    package, _, own = name.partition("/")
    return f"{package}/msg/{own}" if own and "/" not in own else name


@dataclass(frozen=True, slots=True)
class ObservedTopic:
    """A topic that was listened to; ``rate`` is None where its messages come without a rhythm."""

    name: str
    type: str
    latched: bool
    count: int
    mean_bytes: float
    rate: LearnedRate | None


@dataclass(frozen=True, slots=True)
class DiagnosticEntry:
    """A name under which a node reports its state, and the worst level that it reported."""

    name: str
    hardware_id: str
    level: int


@dataclass(frozen=True)
class RobotObservation:
    """Everything that was seen within ``seconds``."""

    plugin: str
    block: SourceBlock
    graph: RobotGraph
    seconds: float
    topics: tuple[ObservedTopic, ...] = ()
    entries: tuple[DiagnosticEntry, ...] = ()
    errors: Mapping[str, int] = field(default_factory=dict)
    """How many errors each writer of a log wrote."""
    remarks: tuple[str, ...] = ()


def block_of(text: str) -> SourceBlock:
    """Build the one block of a text in the form of ``black_box.yaml``; raise its errors."""
    problems: list[Problem] = []
    root = parse_yaml(text, "black_box.yaml", problems)
    blocks = read_blocks(root, SOURCES, problems).sources if root is not None else ()
    raise_errors(problems)
    if not blocks:
        raise UsageError("there is no source in it", "amberbox plugins lists the sources")
    return blocks[0]


def read_robot_graph(block: SourceBlock, wait_s: float) -> RobotGraph:
    """Return what runs on the robot of a block; raise UsageError if its source cannot say."""
    module = get(SOURCES, block.plugin).load()
    if not hasattr(module, "read_graph"):
        raise UsageError(
            f"the source '{block.plugin}' cannot tell what runs", "sources that can: ros, ros2"
        )
    graph: RobotGraph = module.read_graph(block.config, wait_s)
    return graph


def observe(
    graph: RobotGraph, block: SourceBlock, seconds: float, stop: threading.Event | None = None
) -> RobotObservation:
    """Listen to the topics of a block for so many seconds, and read what the nodes said."""
    module: ModuleType = get(SOURCES, block.plugin).load()
    kept = {*LOG_TYPES, *DIAGNOSTIC_TYPES}
    sink = ObservingSink(block.name, kept | {name.replace("/msg/", "/") for name in kept})
    beside: Callable[[Any], Any] = getattr(module, "beside_recorder", lambda same: same)
    source: Any = module.Source(beside(block.config), block.name)
    began_ns = sink.now_ns()
    until_ns = began_ns
    if seconds > 0:
        until_ns = listen(source, block, sink, seconds, stop or threading.Event())
    heard = sink.observed()
    return RobotObservation(
        block.plugin,
        block,
        graph,
        round((until_ns - began_ns) / NS, 1),
        tuple(sorted((_observed(one, until_ns) for one in heard), key=lambda one: one.name)),
        tuple(_entries(heard)),
        _errors(heard),
        tuple(text for kind, text in sink.events if kind != "undecodable"),
    )


def _observed(heard: ObservedStream, until_ns: int) -> ObservedTopic:
    latched = heard.topic.latched
    return ObservedTopic(
        heard.topic.name,
        heard.type,
        latched,
        heard.count,
        heard.total_bytes / heard.count if heard.count else 0.0,
        None if latched else learn_rate(heard.received_ns, until_ns),
    )


def _rows(heard: ObservedStream) -> Rows | None:
    """Return the kept messages of a topic as columns; None where they cannot be read."""
    if not heard.kept:
        return None
    try:
        return unroller(heard.topic).rows(list(heard.kept))
    except AmberboxError:
        return None


def _column(rows: Rows, name: str) -> list[Any]:
    return np.ma.asanyarray(rows.columns[name]).tolist() if name in rows.columns else []


def _entries(heard: Iterable[ObservedStream]) -> Iterator[DiagnosticEntry]:
    """Yield each entry of diagnostics with the worst level that was seen."""
    worst: dict[tuple[str, str], int] = {}
    for one in heard:
        rows = _rows(one) if full_type(one.type) in DIAGNOSTIC_TYPES else None
        table = None if rows is None else rows.children.get("status")
        if table is None:
            continue
        columns = (_column(table, name) for name in ("name", "hardware_id", "level"))
        for name, hardware, level in zip(*columns, strict=False):
            key = str(name), str(hardware)
            worst[key] = max(worst.get(key, 0), _level(level))
    for (name, hardware), level in sorted(worst.items()):
        yield DiagnosticEntry(name, hardware, level)


def _level(value: Any) -> int:
    """Return a level as a number: ROS 1 and 2 send it as a byte."""
    if isinstance(value, bytes):
        return value[0] if value else 0
    return int(value) if isinstance(value, int | float) else 0


def _errors(heard: Iterable[ObservedStream]) -> dict[str, int]:
    """Count the errors in logs by who wrote them."""
    counts: dict[str, int] = {}
    for one in heard:
        least = LOG_TYPES.get(full_type(one.type))
        rows = None if least is None else _rows(one)
        if rows is None or least is None:
            continue
        for name, level in zip(_column(rows, "name"), _column(rows, "level"), strict=False):
            if _level(level) >= least:
                counts[str(name)] = counts.get(str(name), 0) + 1
    return counts
