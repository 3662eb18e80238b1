"""Missions, of a record or a server: list them, begin and end one, find them in recordings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.blackbox.query.mission_search import detect, find
from amberbox.blackbox.retention.missions import RecordedMission, choose, end, start
from amberbox.blackbox.robot_folder.robot_yaml import read_rules
from amberbox.blackbox.store.store import store_path
from amberbox.cli._arguments import (
    accept_where_first,
    add_range_only,
    add_where,
    opened,
    robot_at,
    span_of,
    user_name,
)
from amberbox.cli._output import print_listing, print_notes
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_duration, format_time

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet

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
    """Run the action."""
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
    _print_missions(found, args, "no missions" if known == [] else "no such mission")
    return 0


def _run_start(args: argparse.Namespace) -> int:
    parameters = dict(_pair(text) for text in args.parameter)
    if not is_url(args.where):
        made = start(
            args.where, args.name, mission_id=args.id, parameters=parameters, who=user_name()
        )
        print(made.id)
        return 0
    if args.id:
        raise UsageError("a server makes the ids of its missions itself", "leave out --id")
    fleet, robot = robot_at(args.where)
    with fleet:
        print(fleet.begin_mission(robot, args.name, parameters).id)
    return 0


def _run_end(args: argparse.Namespace) -> int:
    if not is_url(args.where):
        mission = end(args.where, args.id, outcome=args.outcome, who=user_name())
        print(f"{mission.id}: {mission.outcome} after {_lasted(mission)}")
        return 0
    fleet, robot = robot_at(args.where)
    with fleet:
        name = args.id or _open_server_mission(fleet, robot)
        ended = fleet.end_mission(robot, name, args.outcome or "done")
    print(f"{ended.id}: {ended.outcome}")
    return 0


def _open_server_mission(fleet: Fleet, robot: str) -> str:
    """Return the id of the newest mission that was begun on the server and has not ended."""
    lasting = [m for m in fleet.missions(robot) if m.to is None and m.origin == "server"]
    if not lasting:
        raise UsageError("no mission that was begun on the server lasts",
                         "a robot's own mission ends on the robot")  # fmt: skip
    return lasting[0].id


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
    print_notes(notes)
    _print_missions(missions, args, "no new missions")
    return 0


def _print_missions(
    missions: list[RecordedMission], args: argparse.Namespace, nothing: str
) -> None:
    print_listing(missions, RecordedMission.to_json, _HEADER, _row, nothing, as_json=args.json)


def _row(mission: RecordedMission) -> tuple[object, ...]:
    outcome = mission.outcome
    if mission.failed and outcome != "failed":
        outcome += " (failed)"
    parameters = " ".join(f"{key}={value}" for key, value in mission.parameters.items())
    start_text = format_time(mission.from_ns)[:23]
    return mission.id, mission.name, start_text, _lasted(mission), outcome, mission.who, parameters


def _lasted(mission: RecordedMission) -> str:
    return "lasts" if mission.to_ns is None else format_duration(mission.to_ns - mission.from_ns)


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise UsageError(f"'{text}' is no parameter", "write --parameter KEY=VALUE")
    return key, value
