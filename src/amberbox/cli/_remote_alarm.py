"""``amberbox alarm`` of a robot on a server: the server's list, and what people say of it there."""

from __future__ import annotations

import argparse
import time
from typing import Any

import msgspec

from amberbox.cli._output import print_grid, print_json
from amberbox.cli._server import robot_at
from amberbox.client.alarm_models import AlarmLine
from amberbox.client.fleet import Fleet
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.naming import component_named, endings
from amberbox.core.timetext import parse_duration

_HEADER = ("id", "component", "state", "level", "severity", "opened (UTC)", "times", "who",
           "reason", "cause")  # fmt: skip
_STANDING = ("open", "acknowledged", "shelved")


def run_remote(args: argparse.Namespace, action: str, name: str) -> None:
    """List the alarms of a robot, or say something of one."""
    if args.who:
        raise UsageError("on a server it is who the token belongs to", "leave out --who")
    fleet, robot = robot_at(args.where)
    with fleet:
        if action == "list":
            _list(args, fleet.alarms(robot, state=() if args.all else _STANDING))
            return
        alarm = _find(fleet, robot, name)
        changed = _do(fleet, alarm, action, args)
    if args.json:
        print_json(msgspec.to_builtins(changed))
    else:
        print(f"{changed.id} ({changed.origin}): {_state(changed)}")


def _do(fleet: Fleet, alarm: AlarmLine, action: str, args: argparse.Namespace) -> AlarmLine:
    if action == "ack":
        return fleet.acknowledge(alarm.id, alarm.revision, args.note).alarm
    if action == "unshelve":
        return fleet.unshelve(alarm.id, alarm.revision).alarm
    if args.for_ is None or not args.note:
        raise UsageError("an alarm is shelved for some time, and for a reason",
                         "--for 2h --note 'spare part'")  # fmt: skip
    until_ns = time.time_ns() + parse_duration(args.for_)
    return fleet.shelve(alarm.id, alarm.revision, until_ns, args.note).alarm


def _find(fleet: Fleet, robot: str, name: str) -> AlarmLine:
    """Return the alarm that has this id, or is of this component."""
    known = fleet.alarms(robot, state=_STANDING)
    of = {alarm.origin: alarm for alarm in reversed(known)}
    by_name = of | {str(alarm.id): alarm for alarm in known}
    if name not in by_name and endings(name, of):
        name = component_named(name, of)
    if name not in by_name:
        near = did_you_mean(name, by_name)
        raise UsageError(f"there is no alarm '{name}'{near}", "amberbox alarm list URL shows them")
    return by_name[name]


def _list(args: argparse.Namespace, alarms: list[AlarmLine]) -> None:
    if args.json:
        print_json([msgspec.to_builtins(alarm) for alarm in reversed(alarms)])
    elif alarms:
        print_grid(_HEADER, [_row(alarm) for alarm in reversed(alarms)])
    else:
        print("no alarms" if args.all else "no alarms now")


def _row(alarm: AlarmLine) -> tuple[Any, ...]:
    said = alarm.shelved or alarm.acknowledged
    return (
        alarm.id, alarm.origin, _state(alarm), alarm.level, alarm.severity, alarm.opened[:19],
        alarm.count, alarm.owner or (said.who if said else ""), alarm.reason, alarm.cause,
    )  # fmt: skip


def _state(alarm: AlarmLine) -> str:
    until = alarm.shelved.until if alarm.shelved else None
    text = alarm.state + (f" until {until[:16]}" if until else "")
    return text if alarm.active or alarm.state == "resolved" else f"{text}, quiet"
