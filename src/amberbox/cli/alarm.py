"""List the alarms of a robot; acknowledge one, or shelve it for some time."""

from __future__ import annotations

import argparse
import getpass
import time
from collections.abc import Callable, Sequence
from typing import Any

from amberbox.blackbox.follow.records import OwnRecords
from amberbox.blackbox.journal.reserved import ALARM
from amberbox.blackbox.requests import submit
from amberbox.blackbox.store import is_locked, open_store
from amberbox.blackbox.where import store_path
from amberbox.cli._anyorder import add_actions
from amberbox.cli._output import print_grid, print_json
from amberbox.cli._server import PAGE, add_robot
from amberbox.client.address import is_url
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.naming import component_named, endings
from amberbox.core.timetext import NS, format_duration, format_time, parse_duration

KIND = "alarm"
"""Kind of the requests that the watcher takes."""
_WRITER = "watch"
_USAGE = (
    "amberbox alarm [list] WHERE [--all] | ack WHERE ID | shelve WHERE ID --for 2h | "
    "unshelve WHERE ID [--who NAME] [--note TEXT] [--json]"
)
_HEADER = ("id", "state", "level", "severity", "opened (UTC)", "times", "who", "reason")

Row = dict[str, Any]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.usage = _USAGE
    place = f"robot folder or store, or {PAGE}; then the ID of an alarm, or its component"
    words = {name: () if name == "list" else ("ID",) for name in _ACTIONS}
    add_actions(parser, words, "list", place, where_first=True)
    add_robot(parser)
    parser.add_argument("--all", action="store_true", help="list those that have healed, too")
    parser.add_argument("--for", dest="for_", metavar="TIME", help="how long it is shelved: 2h")
    parser.add_argument("--who", default="", metavar="NAME", help="who says so; else the user")
    parser.add_argument("--note", default="", metavar="TEXT", help="a word on why")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List the alarms, or leave a request that the watcher takes."""
    action, rest = args.action, args.rest
    if args.for_ is not None and action != "shelve":
        raise UsageError("--for goes with shelve", _USAGE)
    if len(rest) != (action != "list"):
        wanted = "no more words" if action == "list" else "the ID of one alarm, or its component"
        raise UsageError(f"alarm {action} takes {wanted}", _USAGE)
    if is_url(args.where):
        from amberbox.cli._remote_alarm import run_remote

        run_remote(args, action, *(rest or [""]))
        return 0
    _ACTIONS[action](args, *rest)
    return 0


def newest(where: str) -> list[Row]:
    """Return the newest record of every alarm, in the order in which they opened."""
    written = OwnRecords(open_store(store_path(where)), _WRITER, {ALARM}).step()
    found: dict[str, Row] = {record.values["id"]: dict(record.values) for record in written}
    return sorted(found.values(), key=lambda row: (row["opened_ns"], row["id"]))


def _list(args: argparse.Namespace) -> None:
    rows = [row for row in newest(args.where) if args.all or row["state"] != "healed"]
    if args.json:
        print_json([_document(row) for row in rows])
    elif rows:
        causes = [row.get("cause", "") for row in rows]
        if any(causes):
            shown = [(*_shown(row), cause) for row, cause in zip(rows, causes, strict=True)]
            print_grid((*_HEADER, "cause"), shown)
        else:
            print_grid(_HEADER, map(_shown, rows))
    else:
        print("no alarms" if args.all else "no alarms now")


def _document(row: Row) -> Row:
    """Return a record as programs get it: times as text."""
    times = {"opened": row["opened_ns"], "changed": row["changed_ns"], "until": row["until_ns"]}
    rest = {key: row[key] for key in row if not key.endswith("_ns") and key != "timestamp"}
    return {**rest, **{key: None if t is None else format_time(t) for key, t in times.items()}}


def _shown(row: Row) -> tuple[object, ...]:
    state = row["state"]
    if row["until_ns"] is not None:
        state += f" until {format_time(row['until_ns'])[:16]}"
    opened_at = format_time(row["opened_ns"])[:19]
    return (
        row["id"], state, row["level"], row["severity"], opened_at, row["count"], row["who"],
        row["reason"],
    )  # fmt: skip


def _acknowledge(args: argparse.Namespace, alarm_id: str) -> None:
    _request(args, alarm_id, "acknowledge", "acknowledged")


def _shelve(args: argparse.Namespace, alarm_id: str) -> None:
    if args.for_ is None:
        raise UsageError("an alarm is shelved for some time", "--for 2h")
    duration_ns = parse_duration(args.for_)
    if duration_ns < NS:
        raise UsageError(f"--for {args.for_} is too short", "--for 2h")
    told = f"shelved for {format_duration(duration_ns)}"
    _request(args, alarm_id, "shelve", told, time.time_ns() + duration_ns)


def _unshelve(args: argparse.Namespace, alarm_id: str) -> None:
    _request(args, alarm_id, "unshelve", "taken from the shelf")


def _request(
    args: argparse.Namespace, alarm_id: str, action: str, told: str, until_ns: int | None = None
) -> None:
    """Leave a request about an alarm that lasts; raises UsageError if there is none like that."""
    alarm_id = _check(newest(args.where), alarm_id, action, args.where)
    store = open_store(store_path(args.where))
    values = {
        "id": alarm_id,
        "action": action,
        "who": args.who or _user(),
        "until_ns": until_ns,
        "note": args.note,
    }
    submit(store, KIND, values)
    watched = is_locked(store, _WRITER)
    if args.json:
        print_json({**values, "watched": watched})
        return
    later = "" if watched else " as soon as amberbox watch runs on this store"
    print(f"{alarm_id} will be {told}{later}")


def _check(rows: Sequence[Row], name: str, action: str, where: str) -> str:
    """Return the id of the alarm that lasts and has this id, or is of this component."""
    lasting = {row["id"]: row for row in rows if row["state"] != "healed"}
    of = {row["component"]: row["id"] for row in lasting.values()}
    alarm_id = name
    if name not in lasting and endings(name, of):
        alarm_id = of[component_named(name, of)]
    hint = f"amberbox alarm list {where} shows them"
    if alarm_id not in lasting:
        healed = any(row["id"] == name for row in rows)
        what = f"the alarm '{name}' has healed" if healed else f"there is no alarm '{name}'"
        near = "" if healed else did_you_mean(name, lasting) or did_you_mean(name, of)
        raise UsageError(what + near, hint)
    if action == "unshelve" and lasting[alarm_id]["state"] != "shelved":
        raise UsageError(f"the alarm '{alarm_id}' is not shelved", hint)
    return alarm_id


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user that the system has no name for
        return ""


_ACTIONS: dict[str, Callable[..., None]] = {
    "list": _list,
    "ack": _acknowledge,
    "shelve": _shelve,
    "unshelve": _unshelve,
}
