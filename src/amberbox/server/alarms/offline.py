"""Alarms about robots that are offline: one for those lost together, until all are back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from sqlalchemy import select, update

from amberbox.core.clock import NS
from amberbox.core.names import some_names
from amberbox.core.robot_status import Severity
from amberbox.server.accounts.robots import KnownRobot, list_robots
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.alarm import Alarm, AlarmSettings, Excuse, HistoryEntry, Shared
from amberbox.server.alarms.store import AlarmRegister
from amberbox.server.ingest.link_state import current_statuses, presences
from amberbox.server.schema import ALARM, ALARM_ROBOT

Statuses = Sequence[Mapping[str, Any]]
"""The last statuses of a robot, as its journal has them."""


@dataclass(slots=True)
class AbsenceTracker:
    """Which robots are away, and since when in ns since boot, a clock that never steps."""

    away: dict[str, int] = field(default_factory=dict)
    settled: set[str] = field(default_factory=set)
    """Robots with a decision: there is an alarm, or their absence is excused."""

    def gone(self, robot: str, at_ns: int) -> None:
        """Note that a robot is away since ``at_ns``, or earlier if that is already known."""
        self.away.setdefault(robot, at_ns)

    def back(self, robot: str) -> bool:
        """Remove a robot that is back; return whether its absence had been decided on."""
        self.away.pop(robot, None)
        decided = robot in self.settled
        self.settled.discard(robot)
        return decided

    def missed(
        self, now_ns: int, after_ns: Callable[[str], int], together_ns: int
    ) -> list[list[str]]:
        """Return the robots whose alarm is due, those lost together in one list.

        When the first of a group has been away for too long, all of the group count.
        """
        open_ones = sorted(
            (at_ns, robot) for robot, at_ns in self.away.items() if robot not in self.settled
        )
        found: list[list[str]] = []
        while open_ones:
            first_ns = open_ones[0][0]
            together = [(at, name) for at, name in open_ones if at - first_ns <= together_ns]
            open_ones = open_ones[len(together) :]
            watched = [(at, name) for at, name in together if after_ns(name) > 0]
            if any(now_ns - at_ns >= after_ns(name) for at_ns, name in watched):
                found.append([name for _, name in watched])
        return found


def is_excused(statuses: Statuses, excuses: Iterable[Excuse]) -> bool:
    """Return whether the last statuses of a robot excuse its absence: docked, outside coverage."""
    return any(excuse.value in _values(statuses, excuse.output) for excuse in excuses)


def shared_by(robots: Mapping[str, Statuses], shared: Iterable[Shared]) -> str:
    """Return a property that all robots share, such as ``access point ap-3``; empty if there is
    none.
    """
    for one in shared:
        values = [set(map(str, _values(statuses, one.output))) for statuses in robots.values()]
        common = set.intersection(*values) - {"", "None"} if values else set()
        if common:
            return f"{one.word} {min(common)}"
    return ""


def _values(statuses: Statuses, output: str) -> list[bool | float | str]:
    """Return the values of an output, without missing ones."""
    component, mode, name = output.split("/")
    return [
        value
        for status in statuses
        if component in ("*", status.get("component")) and mode in ("*", status.get("mode"))
        for entry in _outputs(status)
        if name in ("*", entry.get("name")) and (value := _value(entry)) is not None
    ]


def _outputs(status: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the outputs of a status; anything malformed that a robot sends is left out."""
    found = status.get("outputs")
    if isinstance(found, list):
        yield from (entry for entry in found if isinstance(entry, dict))


def _value(entry: Mapping[str, Any]) -> bool | float | str | None:
    kind, value = entry.get("type"), entry.get("value")
    if kind == "string":
        return None if entry.get("text") is None else str(entry["text"])
    if not isinstance(value, bool | int | float):
        return None
    return bool(value) if kind == "bool" else float(value)


CONNECTION: Final = "connection"
"""The common property of robots without any other known one."""
_NAMED = 5


def absent_since_start(register: AlarmRegister, boot_ns: int) -> AbsenceTracker:
    """Return the robots that are away at the start; the server's own downtime does not count."""
    connection = register.connection
    known = {robot.id for robot in list_robots(connection) if robot.disabled_ns is None}
    absence = AbsenceTracker(
        {one.robot: boot_ns for one in presences(connection) if one.robot in known}
    )
    absence.settled = {robot for robot, _ in _away(register)} & absence.away.keys()
    return absence


def _away(register: AlarmRegister) -> list[tuple[str, int]]:
    """Return the robots that an offline alarm lists as away, with the number of the alarm."""
    chosen = (
        select(ALARM_ROBOT.c.robot, ALARM_ROBOT.c.alarm)
        .join(ALARM, ALARM.c.number == ALARM_ROBOT.c.alarm)
        .where(ALARM.c.kind == "offline", ALARM_ROBOT.c.to_ns.is_(None))
    )
    return [(row.robot, row.alarm) for row in register.connection.execute(chosen)]


def open_offline_alarms(
    register: AlarmRegister,
    absence: AbsenceTracker,
    now_ns: int,
    boot_ns: int,
    settings: AlarmSettings,
) -> None:
    """Open alarms for robots that have been away for too long without an excuse.

    Durations are measured in time since boot (``boot_ns``), so a step of the wall clock opens no
    alarm. Alarms carry wall time (``now_ns``).
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
        statuses = {name: current_statuses(register.connection, name) for name in together}
        missing = [
            name for name in together
            if robots[name].disabled_ns is None
            and not is_excused(statuses[name], settings.excused)
        ]  # fmt: skip
        if missing:
            chosen = {name: statuses[name] for name in missing}
            since = {name: now_ns - (boot_ns - absence.away[name]) for name in missing}
            _open(register, since, robots, chosen, now_ns, settings)


def _after_ns(robot: KnownRobot, settings: AlarmSettings) -> int:
    """Return after how many ns a robot counts as missing; 0 is never.

    Its own setting counts first, then the shortest of its groups, then the general one.
    """
    of = settings.offline_after_of
    if robot.id in of:
        return round(of[robot.id] * NS)
    groups = [of[group] for group in robot.groups if group in of]
    return round((min(groups) if groups else settings.offline_after_s) * NS)


def _open(
    register: AlarmRegister,
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
        register.add_robots(known.number, since)
        away = [robot for robot, number in _away(register) if number == known.number]
        register.keep(
            known, lifecycle.lost_again(known, _reason(away, known.origin), now_ns, settings)
        )
        return
    from_ns = min(at_ns for _, at_ns in since)
    alarm = Alarm(
        0, "offline", robot, origin, severity, "unknown", _reason(names, origin), from_ns, now_ns,
        notify_ns=now_ns,
    )  # fmt: skip
    added = register.add(alarm, since, HistoryEntry(now_ns, "opened", alarm.reason))
    register.touched.add(added.number)


def _shared(
    robots: Mapping[str, KnownRobot], missing: Mapping[str, Statuses], settings: AlarmSettings
) -> str:
    """Return the property that robots share: an output of their statuses, a group, the
    connection.
    """
    groups = frozenset.intersection(*(robots[name].groups for name in missing))
    group = f"group {min(groups)}" if groups else ""
    return shared_by(missing, settings.shared) or group or CONNECTION


def _reason(names: Sequence[str], origin: str) -> str:
    if len(names) == 1:
        return f"{names[0]} is offline"
    where = "" if origin == CONNECTION else f", all of {origin}"
    return f"{len(names)} robots are offline{where}: {some_names(names, _NAMED)}"


def _goes_on(
    register: AlarmRegister,
    known: Alarm,
    names: Sequence[str],
    now_ns: int,
    settings: AlarmSettings,
) -> bool:
    """Return whether the robots are away again soon after a known alarm, for the same origin."""
    ended_ns = known.resolved_ns if known.resolved_ns is not None else now_ns
    if now_ns - ended_ns > settings.ns("reopen_s"):
        return False
    chosen = select(ALARM_ROBOT.c.robot).where(ALARM_ROBOT.c.alarm == known.number)
    before = set(register.connection.execute(chosen).scalars())
    return known.origin != CONNECTION or 2 * len(before.intersection(names)) >= len(names)


def end_absences(register: AlarmRegister, robots: Iterable[str], now_ns: int) -> None:
    """Record that robots are back; end an alarm when the last of its robots is back."""
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
            register.keep(alarm, (changed, [HistoryEntry(now_ns, "back", text)]))
