"""Alarms as the API shows them."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import RowMapping

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.fleet.alarms.alarm import Alarm, Kind, State
from amberbox.fleet.alarms.words import Words, read
from amberbox.fleet.api.forms import shown
from amberbox.fleet.api.windows import FROM, Shown
from amberbox.monitoring.plan import Severity

_AROUND_NS = 60 * NS
"""So much before and after an alarm belongs to its window of data."""


class AlarmRobot(Shown):
    """A robot that an alarm is about; ``to`` is null while it lasts."""

    robot: str
    from_: str = FROM
    to: str | None


@dataclass(frozen=True, slots=True)
class Said:
    """What somebody said, and when; ``until`` of what is shelved."""

    who: str
    at: str | None
    until: str | None = None
    reason: str = ""


class Window(Shown):
    """Where its data are: query or fetch them from the robot between these times."""

    robot: str
    from_: str = FROM
    to: str | None


@dataclass(frozen=True, slots=True)
class AlarmLine:
    """An alarm. ``active`` is whether it lasts, ``state`` what people made of it.

    ``diagnosis_revision`` was the last while it lasted (0: not known), ``explained`` what that
    says in words, null where nobody has worked that out.
    """

    id: int
    kind: Kind
    robots: list[AlarmRobot]
    origin: str
    severity: Severity
    level: str
    state: State
    active: bool
    reason: str
    cause: str
    diagnosis: str
    opened: str
    changed: str
    cleared: str | None
    count: int
    late: bool
    owner: str
    acknowledged: Said | None
    shelved: Said | None
    resolved: Said | None
    merged_into: int | None
    window: Window
    revision: int
    diagnosis_revision: int = 0
    explained: Words | None = None


class Consequence(Shown):
    """A component that suffers from the root of the alarm; ``to`` is null while it does."""

    component: str
    level: str
    reason: str
    from_: str = FROM
    to: str | None


@dataclass(frozen=True, slots=True)
class Happening:
    """A line of the history; ``who`` is empty for the server itself."""

    at: str
    who: str
    what: str
    text: str


@dataclass(frozen=True, slots=True)
class AlarmPage:
    """All that is known of an alarm."""

    alarm: AlarmLine
    consequences: list[Consequence]
    history: list[Happening]


def line_of(alarm: Alarm, robots: list[RowMapping]) -> AlarmLine:
    """Return an alarm as it is shown to somebody who may see these of its robots."""
    about = [
        AlarmRobot(robot=r["robot"], from_=format_time(r["from_ns"]), to=shown(r["to_ns"]))
        for r in robots
    ]
    words = read(alarm.words)
    end_ns = None if alarm.cleared_ns is None else alarm.cleared_ns + _AROUND_NS
    window = Window(
        robot=alarm.robot or (about[0].robot if about else ""),
        from_=format_time(max(0, alarm.opened_ns - _AROUND_NS)), to=shown(end_ns),
    )  # fmt: skip
    return AlarmLine(
        id=alarm.number, kind=alarm.kind, robots=about, origin=alarm.origin,
        severity=alarm.severity, level=alarm.level, state=alarm.state, active=alarm.active,
        reason=_reason(alarm, about), cause=alarm.cause, diagnosis=alarm.diagnosis,
        opened=format_time(alarm.opened_ns), changed=format_time(alarm.changed_ns),
        cleared=shown(alarm.cleared_ns), count=alarm.count, late=alarm.late, owner=alarm.owner,
        acknowledged=_acknowledged(alarm), shelved=_shelved(alarm), resolved=_resolved(alarm),
        merged_into=alarm.merged_into, window=window, revision=alarm.revision,
        diagnosis_revision=alarm.revised, explained=words.about(alarm.cause) if words else None,
    )  # fmt: skip


def _reason(alarm: Alarm, about: list[AlarmRobot]) -> str:
    """Return why; of several offline robots only those are named that the caller may see."""
    if alarm.kind == "robot" or alarm.robot:
        return alarm.reason
    away = [one.robot for one in about if one.to is None] or [one.robot for one in about]
    names = ", ".join(away[:5]) + (f" and {len(away) - 5} more" if len(away) > 5 else "")
    return f"offline: {names}"


def _acknowledged(alarm: Alarm) -> Said | None:
    if alarm.acknowledged_ns is None:
        return None
    return Said(alarm.acknowledged_by, format_time(alarm.acknowledged_ns))


def _shelved(alarm: Alarm) -> Said | None:
    if alarm.shelved_until_ns is None:
        return None
    return Said(alarm.shelved_by, None, format_time(alarm.shelved_until_ns))


def _resolved(alarm: Alarm) -> Said | None:
    if alarm.resolved_ns is None:
        return None
    return Said(alarm.resolved_by, format_time(alarm.resolved_ns), reason=alarm.resolution)
