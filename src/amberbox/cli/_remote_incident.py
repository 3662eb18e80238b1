"""``amberbox incident`` of a robot on a server."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import msgspec

from amberbox.blackbox.journal.reserved import PREFIX
from amberbox.cli._output import print_grid, print_json
from amberbox.cli._server import remote_record
from amberbox.cli._text import in_columns, print_lines
from amberbox.client.data_models import Incident
from amberbox.client.remote import RemoteRecord
from amberbox.client.times import time_ns
from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.units import parse_duration_s

_HEADER = ("id", "state", "from (UTC)", "seconds", "who", "reason")


def mark_remote(args: argparse.Namespace, where: str) -> None:
    """Mark a window around now: what the server has of it, or gets, is kept."""
    if not args.reason:
        raise UsageError("on a server others read why it is kept", "--reason TEXT")
    if args.who:
        raise UsageError("on a server it is who the token belongs to", "leave out --who")
    before_s, after_s = parse_duration_s(args.before), parse_duration_s(args.after)
    now_ns = time.time_ns()
    span = now_ns - round(before_s * NS), now_ns + round(after_s * NS)
    with remote_record(where) as record:
        made = record.fleet.mark_incident(record.robot, *span, args.reason)
    if args.json:
        print_json(msgspec.to_builtins(made))
    else:
        print(f"{made.id}: {_range(made)} is kept; what is still on the robot: "
              f"amberbox fetch {where} all {made.from_[:19]} {made.to[:19]}")  # fmt: skip


def run_remote(first: str, rest: list[str], as_json: bool) -> None:
    """List, show or release."""
    with remote_record(rest[0]) as record:
        _ACTIONS[first](record, rest[1:], as_json)


def _list(record: RemoteRecord, rest: list[str], as_json: bool) -> None:
    found = record.fleet.incidents(record.robot)[::-1]
    if as_json:
        print_json([msgspec.to_builtins(incident) for incident in found])
    elif found:
        print_grid(_HEADER, map(_row, found))
    else:
        print("there are no incidents")


def _show(record: RemoteRecord, rest: list[str], as_json: bool) -> None:
    incident = _chosen(record, rest[0])
    span = time_ns(incident.from_), time_ns(incident.to)
    names = [i.name for i in record.items() if not i.topic.startswith(PREFIX)]
    counts = {n: len(record.query(n, ["timestamp"], *span)) for n in names if "__" not in n}
    rows = {name: count for name, count in counts.items() if count}
    if as_json:
        print_json({**msgspec.to_builtins(incident), "items": rows})
        return
    facts = [
        ("incident", incident.id), ("state", incident.state), ("origin", incident.origin),
        ("window", f"{_range(incident)} (UTC)"), ("who", incident.who or incident.trigger),
        ("reason", incident.reason),
    ]  # fmt: skip
    print_lines(in_columns(facts, ""))
    print_lines(["items:", *in_columns([(name, f"{n} rows") for name, n in rows.items()])])


def _release(record: RemoteRecord, rest: list[str], as_json: bool) -> None:
    incident = _chosen(record, rest[0])
    if incident.origin == "robot":
        raise UsageError(f"{incident.id} was marked on the robot", "it is released there")
    released = record.fleet.release_incident(record.robot, incident.id)
    if as_json:
        print_json(msgspec.to_builtins(released))
    else:
        print(f"{released.id} is released: its window is kept no longer than the rest")


_ACTIONS: dict[str, Callable[[RemoteRecord, list[str], bool], None]] = {
    "list": _list,
    "show": _show,
    "release": _release,
}


def _chosen(record: RemoteRecord, name: str) -> Incident:
    known = {one.id: one for one in record.fleet.incidents(record.robot)}
    found = next(iter(known.values()), None) if name == "last" else known.get(name)
    if found is None:
        near = did_you_mean(name, known)
        raise UsageError(f"there is no incident '{name}'{near}", "amberbox incident list URL")
    return found


def _row(incident: Incident) -> tuple[str, ...]:
    seconds = f"{(time_ns(incident.to) - time_ns(incident.from_)) / NS:.1f}"
    who = incident.who or incident.trigger
    return incident.id, incident.state, incident.from_[:19], seconds, who, incident.reason


def _range(incident: Incident) -> str:
    return f"{incident.from_[:23]} to {incident.to[:23]}"
