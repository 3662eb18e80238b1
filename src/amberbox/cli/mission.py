"""List the missions of a record, begin and end one by hand, find them in old recordings."""

from __future__ import annotations

import argparse
import getpass
from pathlib import Path

from amberbox.blackbox.folder.missions import read_rules
from amberbox.blackbox.missions import Mission, choose
from amberbox.blackbox.missions.ask import end, start
from amberbox.blackbox.missions.detect import detect, find
from amberbox.blackbox.where import store_path
from amberbox.cli._anyorder import accept_where_first
from amberbox.cli._output import add_range_only, opened, print_grid, print_json, span_of, tell
from amberbox.cli._server import add_where
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_duration, format_time

_HEADER = ("id", "name", "from (UTC)", "lasted", "outcome", "who", "parameters")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    verbs = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _list(verbs.add_parser("list", help="list missions"))
    _start(verbs.add_parser("start", help="begin a mission now"))
    _end(verbs.add_parser("end", help="end a mission now"))
    _detect(verbs.add_parser("detect", help="find missions in what is recorded already"))
    accept_where_first(parser, verbs.choices, "list")


def _where(parser: argparse.ArgumentParser) -> None:
    add_where(parser, "robot folder or store")


def _list(parser: argparse.ArgumentParser) -> None:
    _where(parser)
    parser.add_argument("--name", help="only missions of this name")
    parser.add_argument("--failed", action="store_true", help="only those that failed")
    parser.add_argument("--last", type=int, metavar="N", help="only the last N")
    add_range_only(parser)
    parser.add_argument("--json", action="store_true", help="a list of objects")


def _start(parser: argparse.ArgumentParser) -> None:
    _where(parser)
    parser.add_argument("name", metavar="NAME", help="what kind of mission, such as transport")
    parser.add_argument("--id", default="", help="its id; without, made of name and time")
    parser.add_argument(
        "--parameter", action="append", default=[], metavar="KEY=VALUE", help="again for more"
    )


def _end(parser: argparse.ArgumentParser) -> None:
    _where(parser)
    parser.add_argument("id", nargs="?", default="", metavar="ID", help="the last one without")
    parser.add_argument("--outcome", default="", help="default: done; failed counts as failed")


def _detect(parser: argparse.ArgumentParser) -> None:
    _where(parser)
    parser.add_argument("--rules", metavar="FILE", help="robot.yaml with missions:")
    parser.add_argument("--dry-run", action="store_true", help="only say what would be found")
    parser.add_argument("--json", action="store_true", help="a list of objects")


def run(args: argparse.Namespace) -> int:
    """Do what the action says."""
    return {"list": _run_list, "start": _run_start, "end": _run_end, "detect": _run_detect}[
        args.action
    ](args)


def _run_list(args: argparse.Namespace) -> int:
    if args.last is not None and args.last < 1:
        raise UsageError("--last must be 1 or more")
    with opened(args.where) as record:
        span = span_of(args, record)
        known = record.missions()
    found = choose(known, args.name, failed=args.failed, last=args.last, span=span)
    _show(found, args.json, "no missions" if known == [] else "no such mission")
    return 0


def _run_start(args: argparse.Namespace) -> int:
    parameters = dict(_pair(text) for text in args.parameter)
    if is_url(args.where):
        from amberbox.cli._remote_mission import start_remote

        print(start_remote(args.where, args.name, args.id, parameters))
        return 0
    mission = start(args.where, args.name, mission_id=args.id, parameters=parameters, who=_user())
    print(mission.id)
    return 0


def _run_end(args: argparse.Namespace) -> int:
    if is_url(args.where):
        from amberbox.cli._remote_mission import end_remote

        ended = end_remote(args.where, args.id, args.outcome)
        print(f"{ended.id}: {ended.outcome}")
        return 0
    mission = end(args.where, args.id, outcome=args.outcome, who=_user())
    print(f"{mission.id}: {mission.outcome} after {_lasted(mission)}")
    return 0


def _run_detect(args: argparse.Namespace) -> int:
    if is_url(args.where):
        raise UsageError(
            "missions are found in old recordings on the robot",
            "there: amberbox mission detect FOLDER; here: amberbox mission list URL",
        )
    rules = read_rules(Path(args.rules or args.where))
    if not rules:
        raise UsageError(
            f"{args.rules or args.where} has no rules for missions", "add missions: to robot.yaml"
        )
    with opened(args.where) as record:
        if args.dry_run:
            missions, notes = find(record, rules)
        else:
            missions, notes = detect(store_path(args.where), rules)
    tell(notes)
    _show(missions, args.json, "no new missions")
    return 0


def _show(missions: list[Mission], as_json: bool, nothing: str) -> None:
    if as_json:
        print_json([mission.to_json() for mission in missions])
    elif missions:
        print_grid(_HEADER, map(_row, missions))
    else:
        print(nothing)


def _row(mission: Mission) -> tuple[object, ...]:
    outcome = mission.outcome
    if mission.failed and outcome != "failed":
        outcome += " (failed)"
    parameters = " ".join(f"{key}={value}" for key, value in mission.parameters.items())
    start_text = format_time(mission.from_ns)[:23]
    return mission.id, mission.name, start_text, _lasted(mission), outcome, mission.who, parameters


def _lasted(mission: Mission) -> str:
    return "lasts" if mission.to_ns is None else format_duration(mission.to_ns - mission.from_ns)


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise UsageError(f"'{text}' is no parameter", "write --parameter KEY=VALUE")
    return key, value


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user that the system has no name for
        return ""
