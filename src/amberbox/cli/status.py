"""Say how a robot and its components are, as its watcher sees them now; wait for one of them."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import msgspec

from amberbox.blackbox.doctor.linked import LOCK, link_in_words, link_state
from amberbox.blackbox.doctor.supervised import LOCK as SUPERVISED
from amberbox.blackbox.folder.folder import inspect_folder, store_of
from amberbox.blackbox.store import is_locked, is_store, open_store
from amberbox.blackbox.where import store_path
from amberbox.cli._anyorder import accept_any_order
from amberbox.cli._colour import painter
from amberbox.cli._output import print_json, tell
from amberbox.cli._server import add_where
from amberbox.cli._statustable import View, detail, overview, waiting
from amberbox.cli._text import print_lines
from amberbox.client.address import is_url
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.naming import component_named
from amberbox.core.terminal import OWN
from amberbox.core.timetext import format_time
from amberbox.core.types import Output, Status
from amberbox.core.units import parse_duration_s
from amberbox.monitoring.messages.board import Board, BoardReader, works
from amberbox.monitoring.messages.formats import FORMATS
from amberbox.monitoring.messages.naming import Naming
from amberbox.monitoring.messages.watched import changed_files
from amberbox.monitoring.plan import Plan

_PERIOD_S = 1.0
_WAIT_S = 0.2
_NAMED = 5
"""So many changed files are named."""
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
    """Print what is known; 1 if anything is not ok or warn, or the watcher says nothing."""
    if is_url(args.where):
        return _remote(args)
    if args.wait is not None:
        return _wait(args, parse_duration_s(args.wait))
    plan = _plan_of(args.where)
    reader = BoardReader(open_store(store_path(args.where)))
    if args.watch:
        _watch(reader, args, plan)
    board = _read(reader, args, plan)
    _show(board, args, plan)
    return _verdict(board, args.component)


def _remote(args: argparse.Namespace) -> int:
    """Do the same of a robot on a server, or of all that it has."""
    from amberbox.cli._remote_status import read_remote, show_remote, wait_remote, watch_remote

    fleet = _of_fleet(args)
    if fleet is not None:
        return fleet
    if args.wait is not None:
        return wait_remote(args, parse_duration_s(args.wait))
    if args.watch:
        watch_remote(args)
    board, tree = read_remote(args)
    if args.json:
        print_json(_as_json(board) | {"robot": tree.robot})
    else:
        show_remote(board, tree, args)
    return _verdict(board, args.component)


def _of_fleet(args: argparse.Namespace) -> int | None:
    """Print the status of each robot of a server; None where one robot of it is meant.

    A server with a single robot means that one, in full.
    """
    from amberbox.cli import _remote_fleet
    from amberbox.client.fleet import Fleet

    if not _remote_fleet.is_fleet(args):
        return None
    with Fleet(args.where) as fleet:
        robots = _remote_fleet.robots_of(fleet)
        if len(robots) < 2:
            return None
        if args.watch:
            _remote_fleet.watch(fleet, args)
        _remote_fleet.show(robots, args)
    return _remote_fleet.verdict(robots)


def _watch(reader: BoardReader, args: argparse.Namespace, plan: Plan | None) -> NoReturn:
    """Draw again and again until Ctrl-C."""
    while True:
        board = _read(reader, args, plan)
        if sys.stdout.isatty():
            print(f"{OWN}[H{OWN}[J", end="")
        _show(board, args, plan)
        sys.stdout.flush()
        time.sleep(_PERIOD_S)


def _read(reader: BoardReader, args: argparse.Namespace, plan: Plan | None) -> Board:
    board = reader.read(time.time_ns())
    known = board.components
    if not args.component:
        return board
    if known:
        args.component = component_named(args.component, known, _titles(plan))
    statuses = [status for status in board.statuses if status.component == args.component]
    return board if args.format == "table" and not args.json else _only(board, statuses)


def _only(board: Board, statuses: Sequence[Status]) -> Board:
    of = {status.component for status in statuses}
    alarms = [alarm for alarm in board.alarms if alarm.component in of]
    return replace(board, statuses=statuses, alarms=alarms)


def _verdict(board: Board, component: str | None) -> int:
    """Return 0 if nothing is in error, and every component that is meant is known to work."""
    meant = [s for s in board.statuses if component in (None, s.component)]
    well = all(works(status) for status in meant if not status.mode)
    in_error = any(status.level == "error" for status in meant)
    return int(bool(board.silence) or in_error or not well)


def _show(board: Board, args: argparse.Namespace, plan: Plan | None) -> None:
    if args.json:
        print_json(_as_json(board))
    elif args.format != "table":
        for message in FORMATS[args.format](board.statuses, Naming.of(plan)):
            print(msgspec.json.encode(message).decode())
    else:
        print_lines(_lines(board, args, plan))
    if args.format == "table" and not args.json and not args.component:
        print_lines(_link_lines(args.where))
    tell(_changes(args.where, board, plan))
    if board.silence:
        print(f"hint: {_UNKNOWN_HINT.format(where=args.where)}", file=sys.stderr)


def _changes(where: str, board: Board, plan: Plan | None) -> Iterator[str]:
    """Say what has changed in the robot folder since the watcher began, and what takes it up."""
    folder = None if is_store(Path(where)) else inspect_folder(where)[0]
    if folder is None and not is_store(Path(where)):
        yield f"the robot folder has errors: amberbox check {where} names them; what runs goes on"
        return
    store = open_store(store_path(where))
    changed = changed_files(store, folder) if folder is not None else []
    if not changed:  # a watcher of an earlier version names no files
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
    """Say how the link to the server is, while there is a process that keeps it."""
    store = open_store(store_path(where))
    if is_locked(store, LOCK):
        yield ""
        yield link_in_words(link_state(store), time.time_ns())


def _lines(board: Board, args: argparse.Namespace, plan: Plan | None) -> Iterator[str]:
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    view = View(plan, painter(sys.stdout), width)
    if args.component and args.component in board.components:
        return detail(board, args.component, view)
    return overview(board, view)


def _wait(args: argparse.Namespace, seconds: float) -> int:
    """Wait for a component, or for all; say in the end what is still waited for."""
    plan = _plan_of(args.where)
    if args.component and (titles := _titles(plan)):
        args.component = component_named(args.component, titles, titles)
    until_s = time.monotonic() + seconds
    reader: BoardReader | None = None
    while True:
        reader = reader or _reader_of(args.where)
        board = Board(silence="nothing is recorded yet")
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


def _titles(plan: Plan | None) -> dict[str, str]:
    return {entry.id: entry.name for entry in plan.components} if plan else {}


def _reader_of(where: str) -> BoardReader | None:
    """Open the store; None as long as nothing has been recorded."""
    path = Path(where)
    store = path if is_store(path) else store_of(path)
    if store is None:
        store = store_path(path)  # says what is wrong
    return BoardReader(open_store(store)) if is_store(store) else None


def _wanted(board: Board, component: str | None, plan: Plan | None) -> list[str]:
    """Name what is waited for; without a component all that have a monitor."""
    if component:
        return [component]
    planned = [entry.id for entry in plan.components if entry.modes] if plan else []
    return planned or [c for c, s in board.components.items() if s.state != "not_monitored"]


def _is_up(board: Board, component: str) -> bool:
    status = board.components.get(component)
    return status is not None and not board.silence and works(status)


def _plan_of(where: str) -> Plan | None:
    """Read what is to be monitored, for names and order; None if WHERE is only a store."""
    from amberbox.monitoring.configuration.load import load_plan

    if is_store(Path(where)) or not Path(where).exists():
        return None
    folder, _ = inspect_folder(where)
    return load_plan(folder)[0] if folder is not None else None


def _as_json(board: Board) -> dict[str, Any]:
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
    """JSON has no NaN and no infinity: they are null."""
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
