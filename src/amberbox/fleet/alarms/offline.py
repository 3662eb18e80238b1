"""Alarms about robots that are away: one for those lost together, until all are back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from sqlalchemy import select, update

from amberbox.core.clock import NS
from amberbox.fleet.accounts.robots import KnownRobot, list_robots
from amberbox.fleet.alarms import machine
from amberbox.fleet.alarms.absence import Absence, Statuses, is_excused, shared_by
from amberbox.fleet.alarms.alarm import Alarm, Entry
from amberbox.fleet.alarms.register import Register
from amberbox.fleet.alarms.settings import AlarmSettings
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT
from amberbox.fleet.linkend.board import board
from amberbox.fleet.linkend.presence import presences
from amberbox.monitoring.plan import Severity

CONNECTION: Final = "connection"
"""What robots share of which nothing else is known."""
_NAMED = 5


def absent_since_start(register: Register, boot_ns: int) -> Absence:
    """Return who is away when the server starts: nobody is missed for the time it was down."""
    connection = register.connection
    known = {robot.id for robot in list_robots(connection) if robot.disabled_ns is None}
    absence = Absence({one.robot: boot_ns for one in presences(connection) if one.robot in known})
    absence.settled = {robot for robot, _ in _away(register)} & absence.away.keys()
    return absence


def _away(register: Register) -> list[tuple[str, int]]:
    """Return the robots that an alarm says are away, and its number."""
    chosen = (
        select(ALARM_ROBOT.c.robot, ALARM_ROBOT.c.alarm)
        .join(ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm)
        .where(ALARM.c.kind == "offline", ALARM_ROBOT.c.to_ns.is_(None))
    )
    return [(row.robot, row.alarm) for row in register.connection.execute(chosen)]


def miss(
    register: Register, absence: Absence, now_ns: int, boot_ns: int, settings: AlarmSettings
) -> None:
    """Open alarms for robots that have been away for too long without an excuse.

    How long is counted from boot (``boot_ns``): a step of the wall clock misses nobody. What an
    alarm tells is wall time (``now_ns``).
    """
    if not absence.away.keys() - absence.settled:
        return
    robots = {robot.id: robot for robot in list_robots(register.connection)}
    for name in absence.away.keys() - robots.keys():
        absence.back(name)
    found = absence.missed(
        boot_ns, lambda name: _after_ns(robots[name], settings), settings.ns("together_s")
    )
    for together in found:
        absence.settled.update(together)
        statuses = {name: board(register.connection, name) for name in together}
        missing = [
            name for name in together
            if robots[name].disabled_ns is None
            and not is_excused(statuses[name], settings.excused)
        ]  # fmt: skip
        if missing:
            told = {name: statuses[name] for name in missing}
            since = {name: now_ns - (boot_ns - absence.away[name]) for name in missing}
            _open(register, since, robots, told, now_ns, settings)


def _after_ns(robot: KnownRobot, settings: AlarmSettings) -> int:
    """Return after how long a robot is missed: its own time, the shortest of its groups, or all's.

    0 is never.
    """
    of = settings.offline_after_of
    if robot.id in of:
        return round(of[robot.id] * NS)
    groups = [of[group] for group in robot.groups if group in of]
    return round((min(groups) if groups else settings.offline_after_s) * NS)


def _open(
    register: Register,
    away_ns: Mapping[str, int],
    robots: Mapping[str, KnownRobot],
    missing: Mapping[str, Statuses],
    now_ns: int,
    settings: AlarmSettings,
) -> None:
    names = sorted(missing)
    robot = names[0] if len(names) == 1 else ""
    origin = CONNECTION if robot else _shared(robots, missing, settings)
    severity: Severity = "urgent" if robot else "critical"
    since = [(name, away_ns[name]) for name in names]
    known = register.newest(robot, origin, "offline")
    if known is not None and _goes_on(register, known, names, now_ns, settings):
        _again(register, known, since, now_ns, settings)
        return
    from_ns = min(at_ns for _, at_ns in since)
    alarm = Alarm(
        0, "offline", robot, origin, severity, "unknown", _reason(names, origin), from_ns, now_ns,
        notify_ns=now_ns,
    )  # fmt: skip
    added = register.add(alarm, since, Entry(now_ns, "opened", alarm.reason))
    register.touched.add(added.number)


def _shared(
    robots: Mapping[str, KnownRobot], missing: Mapping[str, Statuses], settings: AlarmSettings
) -> str:
    """Name what they have in common: what their statuses say, else a group, else the link."""
    groups = frozenset.intersection(*(robots[name].groups for name in missing))
    group = f"group {min(groups)}" if groups else ""
    return shared_by(missing, settings.shared) or group or CONNECTION


def _reason(names: Sequence[str], origin: str) -> str:
    if len(names) == 1:
        return f"{names[0]} is offline"
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    where = "" if origin == CONNECTION else f", all of {origin}"
    return f"{len(names)} robots are offline{where}: {', '.join(names[:_NAMED])}{more}"


def _goes_on(
    register: Register, known: Alarm, names: Sequence[str], now_ns: int, settings: AlarmSettings
) -> bool:
    """Tell whether these robots are away again for what they were away for a moment ago."""
    ended_ns = known.resolved_ns if known.resolved_ns is not None else now_ns
    if now_ns - ended_ns > settings.ns("reopen_s"):
        return False
    chosen = select(ALARM_ROBOT.c.robot).where(ALARM_ROBOT.c.alarm == known.number)
    before = set(register.connection.execute(chosen).scalars())
    return known.origin != CONNECTION or 2 * len(before.intersection(names)) >= len(names)


def _again(
    register: Register,
    known: Alarm,
    since: Sequence[tuple[str, int]],
    now_ns: int,
    settings: AlarmSettings,
) -> None:
    register.add_robots(known.number, since)
    away = [robot for robot, number in _away(register) if number == known.number]
    register.keep(known, machine.lost_again(known, _reason(away, known.origin), now_ns, settings))


def returned(register: Register, robots: Iterable[str], now_ns: int) -> None:
    """Note that robots are there again; an alarm is over when nobody is away any more."""
    names = set(robots)
    held = [(robot, number) for robot, number in _away(register)]
    for number in {number for robot, number in held if robot in names}:
        back = [robot for robot, of in held if of == number and robot in names]
        still = [robot for robot, of in held if of == number and robot not in names]
        register.connection.execute(
            update(ALARM_ROBOT)
            .where(ALARM_ROBOT.c.alarm == number, ALARM_ROBOT.c.robot.in_(back))
            .values(to_ns=now_ns)
        )
        alarm = register.alarm(number)
        if alarm is not None:
            cleared = alarm if still else replace(alarm, active=False, cleared_ns=now_ns)
            text = f"{len(back)} back, {len(still)} away"
            changed = replace(cleared, changed_ns=now_ns)
            register.keep(alarm, (changed, [Entry(now_ns, "back", text)]))
