"""``amberbox status`` of a robot on a server: the same table, from what the server says."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NoReturn

import msgspec

from amberbox.cli._colour import painter
from amberbox.cli._output import tell
from amberbox.cli._server import robot_at
from amberbox.cli._statustable import View, alarms_of, overview, statuses_table, waiting
from amberbox.cli._text import in_columns, print_lines
from amberbox.client.alarm_models import AlarmLine
from amberbox.client.fleet import Fleet
from amberbox.client.models import Component, Condition, StatusTree
from amberbox.client.times import maybe_ns, time_ns
from amberbox.core.errors import AmberboxError
from amberbox.core.naming import component_named
from amberbox.core.terminal import OWN
from amberbox.core.types import Status
from amberbox.monitoring.engine.findings import AlarmChange
from amberbox.monitoring.messages.board import Board, works
from amberbox.monitoring.messages.diagnostics import text_of
from amberbox.monitoring.messages.formats import FORMATS
from amberbox.monitoring.messages.naming import Naming
from amberbox.monitoring.messages.tree import Branch

_WAIT_S = 1.0
_STANDING = ("open", "acknowledged", "shelved")


def board_of(fleet: Fleet, robot: str, args: argparse.Namespace) -> tuple[Board, StatusTree]:
    """Ask the server, and put the id of the component that is meant into ``args``.

    Raises UsageError for one that is not there.
    """
    component = args.component
    tree = fleet.status(robot)
    known = [one.component for one in tree.components]
    if component and known:
        titles = {one.component: one.name for one in tree.components}
        component = args.component = component_named(component, known, titles)
    statuses = [
        status for one in tree.components if component in (None, "", one.component)
        for status in _statuses(robot, one, tree.silence)
    ]  # fmt: skip
    alarms = [
        _alarm(robot, alarm) for alarm in fleet.alarms(robot, state=_STANDING)
        if component in (None, "", alarm.origin)
    ]  # fmt: skip
    measured_ns = max((status.measured_ns for status in statuses), default=0)
    return Board(statuses, alarms, measured_ns, tree.silence), tree


def read_remote(args: argparse.Namespace) -> tuple[Board, StatusTree]:
    """Ask about the robot that WHERE means."""
    fleet, robot = robot_at(args.where)
    with fleet:
        return board_of(fleet, robot, args)


def show_remote(board: Board, tree: StatusTree, args: argparse.Namespace) -> None:
    """Print the table, or one message per line."""
    if args.format != "table":
        for message in FORMATS[args.format](board.statuses, Naming.of(None)):
            print(msgspec.json.encode(message).decode())
        return
    print_lines(_lines(board, tree, args))
    tell([tree.note] if tree.note else [])


def wait_remote(args: argparse.Namespace, seconds: float) -> int:
    """Wait for a component, or for all; say in the end what is still waited for."""
    fleet, robot = robot_at(args.where)
    until_s = time.monotonic() + seconds
    with fleet:
        while True:
            board, _ = board_of(fleet, robot, args)
            wanted = [args.component] if args.component else _judged(board)
            missing = [name for name in wanted if board.silence or not _is_up(board, name)]
            if wanted and not missing:
                return 0
            if time.monotonic() >= until_s:
                said = [waiting(board, name) for name in missing]
                raise AmberboxError("\n".join(said) or board.silence or "nothing is known yet")
            time.sleep(min(_WAIT_S, max(until_s - time.monotonic(), 0)))


def watch_remote(args: argparse.Namespace) -> NoReturn:
    """Draw again every second until Ctrl-C."""
    fleet, robot = robot_at(args.where)
    with fleet:
        while True:
            board, tree = board_of(fleet, robot, args)
            if sys.stdout.isatty():
                print(f"{OWN}[H{OWN}[J", end="")
            show_remote(board, tree, args)
            sys.stdout.flush()
            time.sleep(_WAIT_S)


def _judged(board: Board) -> list[str]:
    return [c for c, s in board.components.items() if s.state != "not_monitored"]


def _is_up(board: Board, name: str) -> bool:
    status = board.components.get(name)
    return status is not None and works(status)


def _statuses(robot: str, one: Component, silence: str) -> Iterator[Status]:
    if one.condition is not None:
        yield _status(robot, one.component, "", one.condition, {}, silence)
    for mode in one.modes:
        outputs = {output.name: output.value for output in mode.outputs}
        yield _status(robot, one.component, mode.mode, mode.condition, outputs, silence)


def _status(
    robot: str,
    component: str,
    mode: str,
    said: Condition,
    outputs: Mapping[str, object],
    silence: str,
) -> Status:
    """Make a status; of a robot that is silent nothing is believed."""
    measured_ns = maybe_ns(said.measured) or 0
    since_ns = maybe_ns(said.since) or 0
    level = "unknown" if silence else said.level
    made = {
        "robot": robot, "component": component, "mode": mode, "level": level,
        "state": said.state, "outputs": outputs, "blocked_by": said.blocked_by,
        "measured_ns": measured_ns, "since_ns": since_ns, "reason": silence or said.reason,
        "config_hash": "",
    }  # fmt: skip
    return msgspec.convert(made, Status)


def _alarm(robot: str, alarm: AlarmLine) -> AlarmChange:
    """Make an alarm as a robot has it; its id is that of the server."""
    said = alarm.shelved or alarm.acknowledged
    state = {"open": "open", "acknowledged": "acknowledged", "shelved": "shelved"}[alarm.state]
    made = {
        "robot": robot, "id": str(alarm.id), "component": alarm.origin,
        "severity": alarm.severity, "state": state, "level": alarm.level, "reason": alarm.reason,
        "opened_ns": time_ns(alarm.opened), "changed_ns": time_ns(alarm.changed),
        "count": alarm.count, "who": said.who if said else "",
        "until_ns": maybe_ns(said.until) if said else None, "config_hash": "",
        "cause": alarm.cause, "diagnosis": alarm.diagnosis,
    }  # fmt: skip
    return msgspec.convert(made, AlarmChange)


def _lines(board: Board, tree: StatusTree, args: argparse.Namespace) -> Iterator[str]:
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    branches = tuple(Branch(one.depth, one.component) for one in tree.components)
    view = View(None, painter(sys.stdout), width, branches)
    if not args.component:
        yield from overview(board, view)
        return
    component = next((one for one in tree.components if one.component == args.component), None)
    if component is None:  # nothing has come of this robot yet
        yield from overview(board, view)
        return
    yield from statuses_table(board, args.component, view)
    yield from _outputs(component)
    yield from _needs(component)
    yield from alarms_of(board, args.component, view)


def _outputs(component: Component) -> Iterator[str]:
    rows = [
        (f"{mode.name} / {o.name}", text_of(o.value), o.expected, o.description)
        for mode in component.modes
        for o in mode.outputs
    ]
    if rows:
        yield ""
        yield from in_columns([("output", "value", "expected", "description"), *rows], "")


def _needs(component: Component) -> Iterator[str]:
    needs = [f"{need.name} ({need.level})" for need in component.needs]
    facts: Sequence[tuple[str, str]] = (
        ("part of", component.part_of),
        (f"needs {component.needs_rule}".strip(), ", ".join(needs)),
        ("recovery actions (not carried out)", ", ".join(component.recovery_actions)),
    )
    told = [f"{what}: {text}" for what, text in facts if text]
    if told:
        yield ""
        yield from told
