"""Ask a robot, by its server, for a window of its record that was not copied; list such windows."""

from __future__ import annotations

import argparse
import time

import msgspec

from amberbox.cli._output import accept_relative_times, print_grid, print_json, tell
from amberbox.cli._server import PAGE, add_robot, robot_at
from amberbox.client.address import is_url
from amberbox.client.data_models import Fetch
from amberbox.client.fleet import Fleet
from amberbox.core.errors import UsageError

ALL = "all"
_POLL_S = 2.0
_HEADER = ("id", "item", "from (UTC)", "to (UTC)", "state", "journals", "who")
_USAGE = "amberbox fetch URL [ITEM FROM TO] [--wait] [--json]"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.usage = _USAGE
    parser.add_argument("where", metavar="URL", help=PAGE)
    add_robot(parser)
    parser.add_argument(
        "window", nargs="*", metavar="ITEM FROM TO",
        help="data item ('all' for all), first time, end; without, what was asked is listed",
    )  # fmt: skip
    parser.add_argument("--wait", action="store_true", help="until all has come, or nothing can")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = "exit status: 0 asked, or come; 1 the robot has nothing of it any more"


def run(args: argparse.Namespace) -> int:
    """Ask for a window, or list those that were asked for."""
    if not is_url(args.where):
        raise UsageError(f"{args.where} is no address of a server", f"{PAGE}")
    if len(args.window) not in (0, 3):
        raise UsageError("a window has an item, a beginning and an end", _USAGE)
    fleet, robot = robot_at(args.where)
    with fleet:
        if not args.window:
            _show(fleet.fetches(robot)[::-1], as_json=args.json)
            return 0
        item, start, end = args.window
        asked = fleet.fetch(robot, "" if item == ALL else item, start, end)
        if args.wait:
            asked = _waited(fleet, robot, asked)
    _show([asked], as_json=args.json)
    return int(asked.state in ("gone", "cancelled"))


def _waited(fleet: Fleet, robot: str, asked: Fetch) -> Fetch:
    """Wait until it is over; Ctrl-C ends the waiting, not the asking."""
    said = ""
    while not asked.is_over:
        state = f"{asked.state}, {asked.copied} of {len(asked.journals)} journals"
        if state != said:
            tell([state])
            said = state
        time.sleep(_POLL_S)
        asked = fleet.fetched(robot, asked.id)
    return asked


def _show(found: list[Fetch], *, as_json: bool) -> None:
    if as_json:
        print_json([msgspec.to_builtins(one) for one in found])
    elif found:
        print_grid(_HEADER, map(_row, found))
        tell(f"{one.id}: {one.reason}" for one in found if one.reason)
    else:
        print("nothing was asked of this robot")


def _row(one: Fetch) -> tuple[str, ...]:
    journals = f"{one.copied} of {len(one.journals)}" if one.journals else "-"
    return one.id, one.item or ALL, one.from_[:23], one.to[:23], one.state, journals, one.who
