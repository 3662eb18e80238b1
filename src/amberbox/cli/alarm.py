"""Alarms of a robot, from its record or its server: list, acknowledge, shelve or resolve them."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from amberbox.blackbox.journal.channels import ALARM
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import is_locked, open_store, store_path, submit
from amberbox.cli._arguments import PAGE, add_actions, add_robot, robot_at, user_name
from amberbox.cli._output import print_json, print_listing
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.names import component_id, ids_ending_in
from amberbox.core.timestamps import NS, format_duration, format_time, parse_duration

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import AlarmLine

KIND = "alarm"  # kind of the requests to the watcher
_WRITER = "watch"
_USAGE = (
    "amberbox alarm [list] WHERE [--all] | ack WHERE ID | shelve WHERE ID --for 2h | "
    "unshelve WHERE ID | resolve WHERE ID --note TEXT [--who NAME] [--note TEXT] [--json]"
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
    parser.add_argument(
        "--all", action="store_true", help="list those that are resolved or have healed, too"
    )
    parser.add_argument("--for", dest="for_", metavar="TIME", help="how long it is shelved: 2h")
    parser.add_argument("--who", default="", metavar="NAME", help="who says so; else the user")
    parser.add_argument("--note", default="", metavar="TEXT", help="a word on why")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List the alarms, or submit a request to the watcher."""
    action, rest = args.action, args.rest
    if args.for_ is not None and action != "shelve":
        raise UsageError("--for goes with shelve", _USAGE)
    if len(rest) != (action != "list"):
        wanted = "no more words" if action == "list" else "the ID of one alarm, or its component"
        raise UsageError(f"alarm {action} takes {wanted}", _USAGE)
    if is_url(args.where):
        _run_on_server(args, action, *rest)
    else:
        _ACTIONS[action](args, *rest)
    return 0


def newest(where: str) -> list[Row]:
    """Return the newest record of every alarm, in the order in which they opened."""
    written = OwnRecords(open_store(store_path(where)), _WRITER, {ALARM}).step()
    found: dict[str, Row] = {record.values["id"]: dict(record.values) for record in written}
    return sorted(found.values(), key=lambda row: (row["opened_ns"], row["id"]))


def _list(args: argparse.Namespace) -> None:
    over = () if args.all else ("healed", "resolved")
    rows = [row for row in newest(args.where) if row["state"] not in over]
    with_cause = any(row.get("cause", "") for row in rows)
    header = (*_HEADER, "cause") if with_cause else _HEADER

    def shown(row: Row) -> tuple[object, ...]:
        return (*_shown(row), row.get("cause", "")) if with_cause else _shown(row)

    print_listing(rows, _document, header, shown, _nothing(args), as_json=args.json)


def _nothing(args: argparse.Namespace) -> str:
    return "no alarms" if args.all else "no alarms now"


def _document(row: Row) -> Row:
    """Return a record for JSON output: times as text."""
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


def _shelve(args: argparse.Namespace, alarm_id: str) -> None:
    if args.for_ is None:
        raise UsageError("an alarm is shelved for some time", "--for 2h")
    duration_ns = parse_duration(args.for_)
    if duration_ns < NS:
        raise UsageError(f"--for {args.for_} is too short", "--for 2h")
    outcome = f"shelved for {format_duration(duration_ns)}"
    _request(args, alarm_id, "shelve", outcome, time.time_ns() + duration_ns)


def _resolve(args: argparse.Namespace, alarm_id: str) -> None:
    if not args.note:
        raise UsageError("an alarm is resolved for a reason", "--note 'a plug was loose'")
    _request(args, alarm_id, "resolve", "resolved")


def _request(
    args: argparse.Namespace, alarm_id: str, action: str, outcome: str, until_ns: int | None = None
) -> None:
    """Submit a request about an open alarm; raises UsageError if there is none."""
    alarm_id = _check(newest(args.where), alarm_id, action, args.where)
    store = open_store(store_path(args.where))
    values = {
        "id": alarm_id,
        "action": action,
        "who": args.who or user_name(),
        "until_ns": until_ns,
        "note": args.note,
    }
    submit(store, KIND, values)
    watched = is_locked(store, _WRITER)
    if args.json:
        print_json({**values, "watched": watched})
        return
    later = "" if watched else " as soon as amberbox watch runs on this store"
    print(f"{alarm_id} will be {outcome}{later}")


def _check(rows: Sequence[Row], name: str, action: str, where: str) -> str:
    """Return the id of the open alarm with this id, or of this component."""
    lasting = {row["id"]: row for row in rows if row["state"] != "healed"}
    of = {row["component"]: row["id"] for row in lasting.values()}
    alarm_id = name
    if name not in lasting and ids_ending_in(name, of):
        alarm_id = of[component_id(name, of)]
    hint = f"amberbox alarm list {where} shows them"
    if alarm_id not in lasting:
        healed = any(row["id"] == name for row in rows)
        what = f"the alarm '{name}' has healed" if healed else f"there is no alarm '{name}'"
        near = "" if healed else did_you_mean(name, lasting) or did_you_mean(name, of)
        raise UsageError(what + near, hint)
    if action == "unshelve" and lasting[alarm_id]["state"] != "shelved":
        raise UsageError(f"the alarm '{alarm_id}' is not shelved", hint)
    return alarm_id


_ACTIONS: dict[str, Callable[..., None]] = {
    "list": _list,
    "ack": partial(_request, action="acknowledge", outcome="acknowledged"),
    "shelve": _shelve,
    "unshelve": partial(_request, action="unshelve", outcome="taken from the shelf"),
    "resolve": _resolve,
}


_SERVER_HEADER = ("id", "component", "state", "level", "severity", "opened (UTC)", "times", "who",
                  "reason", "cause")  # fmt: skip
_SERVER_KEYS = (
    "id", "kind", "robots", "origin", "severity", "level", "state", "active", "reason", "opened",
    "changed", "count", "revision", "window", "cause", "diagnosis", "cleared", "late", "owner",
    "acknowledged", "shelved", "resolved", "merged_into",
)  # fmt: skip
_UNRESOLVED = ("open", "acknowledged", "shelved")


def _run_on_server(args: argparse.Namespace, action: str, name: str = "") -> None:
    """List the alarms of a robot on a server, or change one."""
    if args.who:
        raise UsageError("on a server it is who the token belongs to", "leave out --who")
    fleet, robot = robot_at(args.where)
    with fleet:
        if action == "list":
            alarms = fleet.alarms(robot, state=() if args.all else _UNRESOLVED)[::-1]
            print_listing(
                alarms, _server_json, _SERVER_HEADER, _server_row, _nothing(args),
                as_json=args.json,
            )  # fmt: skip
            return
        changed = _change(fleet, _alarm_named(fleet, robot, name), action, args)
    if args.json:
        print_json(_server_json(changed))
    else:
        print(f"{changed.id} ({changed.origin}): {_state_text(changed)}")


def _server_json(alarm: AlarmLine) -> dict[str, Any]:
    """Return the published fields of an alarm in their order; the type of the client has more."""
    found = msgspec.to_builtins(alarm)
    return {key: found[key] for key in _SERVER_KEYS}


def _change(fleet: Fleet, alarm: AlarmLine, action: str, args: argparse.Namespace) -> AlarmLine:
    if action == "ack":
        return fleet.acknowledge(alarm.id, alarm.revision, args.note).alarm
    if action == "unshelve":
        return fleet.unshelve(alarm.id, alarm.revision).alarm
    if action == "resolve":
        if not args.note:
            raise UsageError("an alarm is resolved for a reason", "--note 'a plug was loose'")
        return fleet.resolve(alarm.id, alarm.revision, args.note).alarm
    if args.for_ is None or not args.note:
        raise UsageError("an alarm is shelved for some time, and for a reason",
                         "--for 2h --note 'spare part'")  # fmt: skip
    until_ns = time.time_ns() + parse_duration(args.for_)
    return fleet.shelve(alarm.id, alarm.revision, until_ns, args.note).alarm


def _alarm_named(fleet: Fleet, robot: str, name: str) -> AlarmLine:
    """Return the alarm with this id, or of this component."""
    known = fleet.alarms(robot, state=_UNRESOLVED)
    of = {alarm.origin: alarm for alarm in reversed(known)}
    by_name = of | {str(alarm.id): alarm for alarm in known}
    if name not in by_name and ids_ending_in(name, of):
        name = component_id(name, of)
    if name not in by_name:
        near = did_you_mean(name, by_name)
        raise UsageError(f"there is no alarm '{name}'{near}", "amberbox alarm list URL shows them")
    return by_name[name]


def _server_row(alarm: AlarmLine) -> tuple[Any, ...]:
    action = alarm.shelved or alarm.acknowledged
    return (
        alarm.id, alarm.origin, _state_text(alarm), alarm.level, alarm.severity, alarm.opened[:19],
        alarm.count, alarm.owner or (action.who if action else ""), alarm.reason, alarm.cause,
    )  # fmt: skip


def _state_text(alarm: AlarmLine) -> str:
    until = alarm.shelved.until if alarm.shelved else None
    text = alarm.state + (f" until {until[:16]}" if until else "")
    return text if alarm.active or alarm.state == "resolved" else f"{text}, quiet"
