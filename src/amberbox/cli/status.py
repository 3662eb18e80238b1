"""Status of a robot's components, from its record or its server; of all robots of a server."""

from __future__ import annotations

import argparse
import math
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.agent.doctor.processes import (
    LINK_LOCK,
    LINK_STATE_FILE,
    MIRROR_LOCK,
    MIRROR_STATE_FILE,
    link_in_words,
    mirror_in_words,
)
from amberbox.agent.doctor.processes import SUPERVISOR_LOCK as SUPERVISED
from amberbox.agent.doctor.subject import read_state
from amberbox.agent.recovery import read_recovery, recovery_lines
from amberbox.agent.recovery_actions import command_lines, folder_recoveries
from amberbox.blackbox.robot_folder.folder import inspect_folder, store_of
from amberbox.blackbox.store.store import is_locked, is_store, open_store, store_path
from amberbox.cli._arguments import accept_any_order, add_where, robot_at
from amberbox.cli._output import (
    in_columns,
    painter,
    print_json,
    print_lines,
    print_notes,
    redraw,
    terminal_width,
)
from amberbox.cli._status_table import (
    StatusView,
    alarms_of,
    detail,
    overview,
    statuses_table,
    waiting,
)
from amberbox.client.address import is_url, read_address
from amberbox.client.models import maybe_ns, time_ns
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.names import component_id
from amberbox.core.robot_status import RANK, WORDS, Observed, RobotStatus, judge
from amberbox.core.timestamps import format_time
from amberbox.core.types import Level, Output, Status
from amberbox.core.units import parse_duration_s
from amberbox.monitoring.current_state import (
    CurrentState,
    CurrentStateReader,
    changed_files,
    is_usable,
)
from amberbox.monitoring.findings import AlarmChange
from amberbox.monitoring.plan import ComponentDepth, MonitoringPlan, Naming
from amberbox.monitoring.publishers.diagnostics import text_of
from amberbox.monitoring.status_publisher import FORMATS

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import AlarmLine, Card, Component, Condition, StatusTree


_PERIOD_S = 1.0
_WAIT_S = 0.2
_NAMED = 5  # number of changed files that are named
_UNKNOWN_HINT = "amberbox watch {where} judges what is recorded"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_any_order(parser)
    add_where(parser, "robot folder or store, a server for all its robots")
    parser.add_argument("component", nargs="?", metavar="COMPONENT", help="only this one, in full")
    parser.add_argument(
        "--wait", metavar="TIME", help="wait so long (30s) for it to be ok and initialised"
    )
    parser.add_argument("--watch", action="store_true", help="draw anew every second")
    parser.add_argument(
        "--format", choices=["table", *FORMATS], default="table",
        help="as messages for others, one per line, instead of a table",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print the statuses; return 1 if any is not ok or warn, or the watcher is silent."""
    if is_url(args.where):
        return _run_on_server(args)
    if args.wait is not None:
        return _wait(args, parse_duration_s(args.wait))
    plan = _plan_of(args.where)
    reader = CurrentStateReader(open_store(store_path(args.where)))
    if args.watch:
        redraw(lambda: _show(_read(reader, args, plan), args, plan), _PERIOD_S)
    board = _read(reader, args, plan)
    _show(board, args, plan)
    return _verdict(board, args.component)


def _run_on_server(args: argparse.Namespace) -> int:
    """Print the statuses of a robot on a server, or of all of its robots; return as ``run``."""
    verdict = _of_fleet(args)
    if verdict is not None:
        return verdict
    if args.wait is not None:
        return _wait_on_server(args, parse_duration_s(args.wait))
    fleet, robot = robot_at(args.where)
    with fleet:
        if args.watch:
            redraw(lambda: _show_on_server(*_board_of(fleet, robot, args), args), _PERIOD_S)
        board, tree = _board_of(fleet, robot, args)
    if args.json:
        print_json(_as_json(board) | {"robot": tree.robot})
    else:
        _show_on_server(board, tree, args)
    return _verdict(board, args.component)


def _of_fleet(args: argparse.Namespace) -> int | None:
    """Print the status of each robot of a server; None if a single robot is chosen.

    If the server has only one robot, that robot is shown in full.
    """
    from amberbox.client.fleet import Fleet

    if not _is_fleet(args):
        return None
    with Fleet(args.where) as fleet:
        robots = _robots_of(fleet)
        if len(robots) < 2:
            return None
        if args.watch:
            redraw(lambda: _print_fleet(_robots_of(fleet), args), _PERIOD_S)
        _print_fleet(robots, args)
    return _fleet_verdict(robots)


def _read(
    reader: CurrentStateReader, args: argparse.Namespace, plan: MonitoringPlan | None
) -> CurrentState:
    board = reader.read(time.time_ns())
    known = board.components
    if not args.component:
        return board
    if known:
        args.component = component_id(args.component, known, _titles(plan))
    statuses = [status for status in board.statuses if status.component == args.component]
    return board if args.format == "table" and not args.json else _only(board, statuses)


def _only(board: CurrentState, statuses: Sequence[Status]) -> CurrentState:
    of = {status.component for status in statuses}
    alarms = [alarm for alarm in board.alarms if alarm.component in of]
    return replace(board, statuses=statuses, alarms=alarms)


def _verdict(board: CurrentState, component: str | None) -> int:
    """Return 0 if nothing is in error, and every chosen component is known to work, else 1."""
    meant = [s for s in board.statuses if component in (None, s.component)]
    well = all(is_usable(status) for status in meant if not status.mode)
    in_error = any(status.level == "error" for status in meant)
    return int(bool(board.silence) or in_error or not well)


def _show(board: CurrentState, args: argparse.Namespace, plan: MonitoringPlan | None) -> None:
    if args.json:
        print_json(_as_json(board))
    elif args.format != "table":
        for message in FORMATS[args.format](board.statuses, Naming.of(plan)):
            print(msgspec.json.encode(message).decode())
    else:
        print_lines(_lines(board, args, plan))
    if args.format == "table" and not args.json:
        print_lines(_recovery_lines(args.where, args.component))
    if args.format == "table" and not args.json and not args.component:
        print_lines(_link_lines(args.where))
    print_notes(_changes(args.where, board, plan))
    if board.silence:
        print(f"hint: {_UNKNOWN_HINT.format(where=args.where)}", file=sys.stderr)


def _recovery_lines(where: str, component: str | None) -> Iterator[str]:
    """Yield what the rules of recovery do now, and the commands that may help a component."""
    yield from recovery_lines(read_recovery(open_store(store_path(where))))
    folder = inspect_folder(where)[0] if component and not is_store(Path(where)) else None
    if folder is None or component is None:
        return
    found = folder_recoveries(folder)
    causes = [one.cause for one in found if one.cause.partition("#")[0] == component]
    yield from (f"by hand: {line}" for line in command_lines(found, causes, where))


def _changes(where: str, board: CurrentState, plan: MonitoringPlan | None) -> Iterator[str]:
    """Yield notes on changes of the robot folder since the watcher began, and how to apply them."""
    folder = None if is_store(Path(where)) else inspect_folder(where)[0]
    if folder is None and not is_store(Path(where)):
        yield f"the robot folder has errors: amberbox check {where} names them; what runs goes on"
        return
    store = open_store(store_path(where))
    changed = changed_files(store, folder) if folder is not None else []
    if not changed:  # an earlier version of the watcher names no files
        if plan and {status.config_hash for status in board.statuses} - {plan.config_hash}:
            yield "the robot folder is not as it was when the watcher began"
        return
    more = f" and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
    names = ", ".join(changed[:_NAMED])
    yield f"the robot folder has changed since the watcher began: {names}{more}"
    if is_locked(store, SUPERVISED):
        yield "amberbox run takes it up by itself once the folder is right and at rest"
    else:
        yield f"a restart of amberbox watch {where} takes it up"


def _link_lines(where: str) -> Iterator[str]:
    """Yield a line on the link to the server and on the mirror, while their processes run."""
    store = open_store(store_path(where))
    if is_locked(store, LINK_LOCK):
        yield ""
        yield link_in_words(read_state(store, LINK_STATE_FILE), time.time_ns())
    if is_locked(store, MIRROR_LOCK):
        yield ""
        yield mirror_in_words(read_state(store, MIRROR_STATE_FILE), time.time_ns())


def _lines(
    board: CurrentState, args: argparse.Namespace, plan: MonitoringPlan | None
) -> Iterator[str]:
    width = terminal_width()
    view = StatusView(plan, painter(sys.stdout), width)
    if args.component and args.component in board.components:
        return detail(board, args.component, view)
    return overview(board, view)


def _wait(args: argparse.Namespace, seconds: float) -> int:
    """Wait until a component, or all, are usable; raise AmberboxError with the others after a
    limit.
    """
    plan = _plan_of(args.where)
    if args.component and (titles := _titles(plan)):
        args.component = component_id(args.component, titles, titles)
    until_s = time.monotonic() + seconds
    reader: CurrentStateReader | None = None
    while True:
        reader = reader or _reader_of(args.where)
        board = CurrentState(silence="nothing is recorded yet")
        if reader is not None:
            board = reader.read(time.time_ns())
        missing = [name for name in _wanted(board, args.component, plan) if not _is_up(board, name)]
        if not missing and board.statuses:
            return 0
        if time.monotonic() >= until_s:
            raise AmberboxError(
                "\n".join(waiting(board, name) for name in missing) or board.silence,
                _UNKNOWN_HINT.format(where=args.where) if board.silence else "",
            )
        time.sleep(min(_WAIT_S, max(until_s - time.monotonic(), 0)))


def _titles(plan: MonitoringPlan | None) -> dict[str, str]:
    return {entry.id: entry.name for entry in plan.components} if plan else {}


def _reader_of(where: str) -> CurrentStateReader | None:
    """Return a reader of the store; None as long as nothing has been recorded."""
    path = Path(where)
    store = path if is_store(path) else store_of(path)
    if store is None:
        store = store_path(path)  # raises with the reason
    return CurrentStateReader(open_store(store)) if is_store(store) else None


def _wanted(board: CurrentState, component: str | None, plan: MonitoringPlan | None) -> list[str]:
    """Return the components to wait for; without one given, all that have a monitor."""
    if component:
        return [component]
    planned = [entry.id for entry in plan.components if entry.modes] if plan else []
    return planned or [c for c, s in board.components.items() if s.state != "not_monitored"]


def _is_up(board: CurrentState, component: str) -> bool:
    status = board.components.get(component)
    return status is not None and not board.silence and is_usable(status)


def _plan_of(where: str) -> MonitoringPlan | None:
    """Load the monitoring plan, for names and order; None if WHERE is only a store."""
    from amberbox.monitoring.plan_loader import load_plan

    if is_store(Path(where)) or not Path(where).exists():
        return None
    folder, _ = inspect_folder(where)
    return load_plan(folder)[0] if folder is not None else None


def _as_json(board: CurrentState) -> dict[str, Any]:
    return {
        "robot": board.robot,
        "measured": format_time(board.measured_ns) if board.measured_ns else None,
        "silence": board.silence,
        "monitoring": board.monitoring and board.monitoring._asdict(),
        "components": [
            _status_json(status) | {"modes": [_mode_json(m) for m in board.modes_of(name)]}
            for name, status in board.components.items()
        ],
        "alarms": [
            {
                "id": alarm.id,
                "component": alarm.component,
                "severity": alarm.severity,
                "state": alarm.state,
                "cause": alarm.cause,
                "diagnosis": alarm.diagnosis,
                "reason": alarm.reason,
                "opened": format_time(alarm.opened_ns),
                "count": alarm.count,
                "who": alarm.who,
                "until": format_time(alarm.until_ns) if alarm.until_ns is not None else None,
            }
            for alarm in board.alarms
        ],
    }


def _mode_json(status: Status) -> dict[str, Any]:
    outputs = {name: _in_json(value) for name, value in status.outputs.items()}
    return {"mode": status.mode, **_status_json(status), "outputs": outputs}


def _in_json(value: Output) -> Output:
    """Return a value for JSON, with None for NaN and infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _status_json(status: Status) -> dict[str, Any]:
    return {
        "component": status.component,
        "level": status.level,
        "state": status.state,
        "reason": status.reason,
        "blocked_by": list(status.blocked_by),
        "since": format_time(status.since_ns),
        "for_s": (status.measured_ns - status.since_ns) / NS,
        "live_only": status.live_only,
    }


_NARROWEST = 24


@dataclass(frozen=True, slots=True)
class _FleetRobot:
    """A robot of a server with its status."""

    card: Card
    status: RobotStatus


def _is_fleet(args: argparse.Namespace) -> bool:
    """Return whether WHERE is a whole server, without a robot or component."""
    one = read_address(args.where).robot or args.component or args.wait is not None
    return not one and args.format == "table"


def _robots_of(fleet: Fleet) -> list[_FleetRobot]:
    """Return the visible robots, the worst first, disabled ones at the end."""
    found = [_FleetRobot(card, _fleet_status(card)) for card in fleet.robots()]
    return sorted(found, key=lambda one: (one.card.disabled, -one.status.rank, one.card.robot))


def _print_fleet(robots: Sequence[_FleetRobot], args: argparse.Namespace) -> None:
    """Print a line for each robot, or JSON."""
    if args.json:
        print_json({"server": read_address(args.where).url,
                    "robots": [_robot_json(one) for one in robots]})  # fmt: skip
        return
    print("\n".join(_fleet_lines(robots)))


def _fleet_verdict(robots: Sequence[_FleetRobot]) -> int:
    """Return 0 if every robot that is not disabled is known to work, else 1."""
    meant = (one for one in robots if not one.card.disabled)
    return int(any(one.status.level not in ("ok", "warn") for one in meant))


def _fleet_status(card: Card) -> RobotStatus:
    """Return the status that the server states; for an older server, computed from its card."""
    if card.status is not None:
        stated = msgspec.to_builtins(card.status)
        known = {**stated, "level": _level(card.status.level),
                 "last_level": _level(card.status.last_level)}  # fmt: skip
        return RobotStatus(**known)
    seen = Observed(
        "online" if card.online else "offline" if card.last_seen else "never",
        "running" if card.level != "unknown" or not card.online else "silent",
        _level(card.last_level or card.level), card.cause, as_of=card.last_seen,
    )  # fmt: skip
    return judge(seen)


def _level(text: str) -> Level:
    """Return a level; ``unknown`` for a text that this version does not know."""
    return next((level for level in RANK if level == text), "unknown")


def _fleet_lines(robots: Sequence[_FleetRobot]) -> Iterator[str]:
    paint = painter(sys.stdout)
    width = terminal_width()
    levels = Counter(one.status.level for one in robots)
    ordered = sorted(levels, key=RANK.__getitem__, reverse=True)
    counted = ", ".join(paint(f"{levels[level]} {WORDS[level]}", level) for level in ordered)
    yield f"{len(robots)} {'robot' if len(robots) == 1 else 'robots'}: {counted}"
    header = ("robot", "status", "alarms")
    alarms = [f"{one.card.alarms} open" if one.card.alarms else "" for one in robots]
    rows = [
        (one.card.robot, WORDS[one.status.level], count)
        for one, count in zip(robots, alarms, strict=True)
    ]
    widths = [2 + max(map(len, column)) for column in zip(header, *rows, strict=True)]
    at, end = widths[0], sum(widths)
    lines = in_columns([header, *rows], "")
    yield lines[0]
    for line, (_, word, _), one in zip(lines[1:], rows, robots, strict=True):
        text = _robot_text(one)
        room = None if width is None else max(width - end, _NARROWEST)
        first, *more = [text] if room is None else textwrap.wrap(text, room) or [""]
        line = line.ljust(end)
        yield line[:at] + paint(word, one.status.level) + line[at + len(word) :] + first
        yield from (" " * end + text for text in more)


def _robot_text(one: _FleetRobot) -> str:
    """Return a robot's status as one line, with its time for a disconnected robot."""
    status = one.status
    if one.card.disabled:
        return "Switched off by an admin."
    if status.is_current:
        return " ".join(f"{status.text} {status.reason}".split())
    away = {"offline": "Offline.", "silent": "Silent.", "never": "Never connected."}
    as_of = f"(as of {status.as_of[:19]}Z)" if status.as_of else ""
    return " ".join(filter(None, (away.get(status.contact), status.text, as_of)))


def _robot_json(one: _FleetRobot) -> dict[str, object]:
    card = one.card
    return {
        "robot": card.robot, "groups": list(card.groups), "online": card.online,
        "last_seen": card.last_seen, "alarms": card.alarms,
        **msgspec.to_builtins(one.status),
    }  # fmt: skip


_SERVER_WAIT_S = 1.0
_UNRESOLVED = ("open", "acknowledged", "shelved")


def _board_of(
    fleet: Fleet, robot: str, args: argparse.Namespace
) -> tuple[CurrentState, StatusTree]:
    """Return the current state from the server; put the component's full id into ``args``.

    Raises UsageError for an unknown component.
    """
    component = args.component
    tree = fleet.status(robot)
    known = [one.component for one in tree.components]
    if component and known:
        titles = {one.component: one.name for one in tree.components}
        component = args.component = component_id(component, known, titles)
    statuses = [
        status for one in tree.components if component in (None, "", one.component)
        for status in _statuses_of(robot, one, tree.silence)
    ]  # fmt: skip
    alarms = [
        _alarm_of(robot, alarm) for alarm in fleet.alarms(robot, state=_UNRESOLVED)
        if component in (None, "", alarm.origin)
    ]  # fmt: skip
    measured_ns = max((status.measured_ns for status in statuses), default=0)
    return CurrentState(statuses, alarms, measured_ns, tree.silence), tree


def _show_on_server(board: CurrentState, tree: StatusTree, args: argparse.Namespace) -> None:
    """Print the table, or one message per line."""
    if args.format != "table":
        for message in FORMATS[args.format](board.statuses, Naming.of(None)):
            print(msgspec.json.encode(message).decode())
        return
    print_lines(_server_lines(board, tree, args))
    print_notes([tree.note] if tree.note else [])


def _wait_on_server(args: argparse.Namespace, seconds: float) -> int:
    """Wait until a component, or all, are usable; raise AmberboxError with the others after a
    limit.
    """
    fleet, robot = robot_at(args.where)
    until_s = time.monotonic() + seconds
    with fleet:
        while True:
            board, _ = _board_of(fleet, robot, args)
            known = board.components
            monitored = [name for name, s in known.items() if s.state != "not_monitored"]
            wanted = [args.component] if args.component else monitored
            missing = [
                name for name in wanted
                if board.silence or name not in known or not is_usable(known[name])
            ]  # fmt: skip
            if wanted and not missing:
                return 0
            if time.monotonic() >= until_s:
                waited = [waiting(board, name) for name in missing]
                raise AmberboxError("\n".join(waited) or board.silence or "nothing is known yet")
            time.sleep(min(_SERVER_WAIT_S, max(until_s - time.monotonic(), 0)))


def _statuses_of(robot: str, one: Component, silence: str) -> Iterator[Status]:
    if one.condition is not None:
        yield _status_of(robot, one.component, "", one.condition, {}, silence)
    for mode in one.modes:
        outputs = {output.name: output.value for output in mode.outputs}
        yield _status_of(robot, one.component, mode.mode, mode.condition, outputs, silence)


def _status_of(
    robot: str,
    component: str,
    mode: str,
    condition: Condition,
    outputs: Mapping[str, object],
    silence: str,
) -> Status:
    """Return a status; its level is unknown where the robot is silent."""
    measured_ns = maybe_ns(condition.measured) or 0
    since_ns = maybe_ns(condition.since) or 0
    level = "unknown" if silence else condition.level
    made = {
        "robot": robot, "component": component, "mode": mode, "level": level,
        "state": condition.state, "outputs": outputs, "blocked_by": condition.blocked_by,
        "measured_ns": measured_ns, "since_ns": since_ns, "reason": silence or condition.reason,
        "config_hash": "",
    }  # fmt: skip
    return msgspec.convert(made, Status)


def _alarm_of(robot: str, alarm: AlarmLine) -> AlarmChange:
    """Return an alarm in the form of a robot's record, with the server's id."""
    action = alarm.shelved or alarm.acknowledged
    state = {"open": "open", "acknowledged": "acknowledged", "shelved": "shelved"}[alarm.state]
    made = {
        "robot": robot, "id": str(alarm.id), "component": alarm.origin,
        "severity": alarm.severity, "state": state, "level": alarm.level, "reason": alarm.reason,
        "opened_ns": time_ns(alarm.opened), "changed_ns": time_ns(alarm.changed),
        "count": alarm.count, "who": action.who if action else "",
        "until_ns": maybe_ns(action.until) if action else None, "config_hash": "",
        "cause": alarm.cause, "diagnosis": alarm.diagnosis,
    }  # fmt: skip
    return msgspec.convert(made, AlarmChange)


def _server_lines(board: CurrentState, tree: StatusTree, args: argparse.Namespace) -> Iterator[str]:
    width = terminal_width()
    branches = tuple(ComponentDepth(one.depth, one.component) for one in tree.components)
    view = StatusView(None, painter(sys.stdout), width, branches)
    if not args.component:
        yield from overview(board, view)
        return
    component = next((one for one in tree.components if one.component == args.component), None)
    if component is None:  # nothing has arrived from this robot yet
        yield from overview(board, view)
        return
    yield from statuses_table(board, args.component, view)
    rows = [
        (f"{mode.name} / {o.name}", text_of(o.value), o.expected, o.description)
        for mode in component.modes
        for o in mode.outputs
    ]
    if rows:
        yield ""
        yield from in_columns([("output", "value", "expected", "description"), *rows], "")
    needs = [f"{need.name} ({need.level})" for need in component.needs]
    facts: Sequence[tuple[str, str]] = (
        ("part of", component.part_of),
        (f"needs {component.needs_rule}".strip(), ", ".join(needs)),
        ("recovery actions", ", ".join(component.recovery_actions)),
    )
    shown = [f"{what}: {text}" for what, text in facts if text]
    if shown:
        yield ""
        yield from shown
    yield from alarms_of(board, args.component, view)
