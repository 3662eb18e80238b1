"""What suffers from the root of an alarm: components that are blocked by it, near or far."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from sqlalchemy import RowMapping, select

from amberbox.fleet.alarms.alarm import Alarm, Part
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.alarms.reports import Report
from amberbox.fleet.alarms.tables import ALARM, CONSEQUENCE
from amberbox.fleet.database.upsert import upsert
from amberbox.monitoring.engine.findings import Transition

_MOST = 100
"""Names in a list of what blocks something; more are not of use to anybody."""


def note_blocked(register: Register, report: Report, told: Transition) -> None:
    """Take a transition of a component, unless a later one is known."""
    if told.mode:
        return
    component = told.component[:128]
    known = register.blocked(report.robot).get(component)
    same = known is not None and known["store_id"] == report.store_id
    if known is not None and same and (report.run, report.seq) <= (known["run"], known["seq"]):
        return
    register.keep_blocked({
        "robot": report.robot, "component": component, "level": told.after.level,
        "blocked_by": json.dumps([name[:128] for name in told.blocked_by[:_MOST]]),
        "reason": told.reason, "since_ns": min(max(told.at_ns + report.offset_ns, 0), 1 << 62),
        "store_id": report.store_id, "run": report.run, "seq": report.seq,
    })  # fmt: skip


def root_of(register: Register, robot: str, origin: str) -> Part | None:
    """Return the part that lasts of a component, or of what that one is blocked by."""
    lasting = {part.component: part for part in register.lasting(robot)}
    blocked = register.blocked(robot)
    waiting, seen = [origin], {origin}
    while waiting:
        name = waiting.pop(0)
        if name in lasting:
            return lasting[name]
        new = [by for by in _blockers(blocked, name) if by not in seen]
        waiting += new
        seen.update(new)
    return None


def _blockers(blocked: Mapping[str, Any], name: str) -> list[str]:
    row = blocked.get(name)
    return [] if row is None else list(json.loads(row["blocked_by"]))


def show_consequences(register: Register, robot: str) -> None:
    """List what suffers under the root of each alarm that lasts; note what suffers no more."""
    blocked = register.blocked(robot)
    open_ones = register.alarms(
        ALARM.c.robot == robot, ALARM.c.state != "resolved", ALARM.c.kind == "robot"
    )
    for alarm in open_ones:
        parts = register.parts(alarm.number)
        own = {part.component for part in parts if part.component == alarm.origin}
        found = _below(own, blocked) if alarm.active else {}
        for part in parts:
            if part.component not in own and part.active:
                found[part.component] = (part.level, part.reason, part.opened_ns)
            elif part.component not in own and alarm.active and _still_fails(part, blocked):
                row = blocked[part.component]
                found[part.component] = (row["level"], row["reason"], row["since_ns"])
        _keep(register, alarm, found, blocked)


def _still_fails(part: Part, blocked: Mapping[str, Any]) -> bool:
    """Tell whether a component fails whose alarm has become part of another."""
    row = blocked.get(part.component)
    return row is not None and row["level"] in ("warn", "stale", "error")


def _below(roots: set[str], blocked: Mapping[str, Any]) -> dict[str, tuple[str, str, int]]:
    """Follow what is blocked from the roots on."""
    found: dict[str, tuple[str, str, int]] = {}
    grown = True
    while grown:
        grown = False
        for name, row in blocked.items():
            if name in found or name in roots or row["level"] == "ok":
                continue
            by = set(json.loads(row["blocked_by"]))
            if by & (roots | found.keys()):
                found[name] = (row["level"], row["reason"], row["since_ns"])
                grown = True
    return found


def _keep(
    register: Register, alarm: Alarm, found: Mapping[str, tuple[str, str, int]],
    blocked: Mapping[str, Any],
) -> None:  # fmt: skip
    """Keep what suffers: since it began, whatever becomes of it; what is over with its end."""
    chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm == alarm.number)
    known = {row["component"]: row for row in register.connection.execute(chosen).mappings()}
    rows = [
        {"alarm": alarm.number, "component": name, "level": level, "reason": reason[:2000],
         "from_ns": _beginning(known.get(name), from_ns), "to_ns": None}
        for name, (level, reason, from_ns) in found.items()
    ]  # fmt: skip
    rows += [{**row, "to_ns": _end(alarm, row, blocked.get(name))} for name, row in known.items()
             if name not in found and row["to_ns"] is None]  # fmt: skip
    changed = [row for row in rows if row != dict(known.get(row["component"], {}))]
    if changed:
        change = ("level", "reason", "from_ns", "to_ns")
        statement = upsert(register.connection.dialect, CONSEQUENCE, ("alarm", "component"), change)
        register.connection.execute(statement, changed)
        register.touched.add(alarm.number)


def _beginning(known: RowMapping | None, from_ns: int) -> int:
    """Return since when something suffers that goes on, however its state changes meanwhile."""
    lasts = known is not None and known["to_ns"] is None
    return min(known["from_ns"], from_ns) if known is not None and lasts else from_ns


def _end(alarm: Alarm, row: RowMapping, now: RowMapping | None) -> int:
    """Return when something stopped to suffer: by its own last word, or with the alarm.

    Never before it began: the alarm's last word can be older than that.
    """
    begun_ns: int = row["from_ns"]
    ends = [] if now is None else [now["since_ns"]]
    if not alarm.active:
        ends.append(alarm.changed_ns if alarm.cleared_ns is None else alarm.cleared_ns)
    return min(
        (at_ns for at_ns in ends if at_ns > begun_ns), default=max(begun_ns, alarm.changed_ns)
    )
