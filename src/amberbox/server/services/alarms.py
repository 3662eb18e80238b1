"""Alarms and notifications as API and pages show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection, RowMapping, select

from amberbox.core.api import (
    AlarmLine,
    AlarmPage,
    AlarmRobot,
    AlarmState,
    Consequence,
    Happening,
    Said,
    Window,
)
from amberbox.core.clock import NS
from amberbox.core.names import some_names
from amberbox.core.robot_status import Severity
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.server.alarms import store
from amberbox.server.alarms.alarm import Alarm, decode_words
from amberbox.server.alarms.store import AlarmQuery, AlarmRegister
from amberbox.server.schema import OUTBOX
from amberbox.server.services.context import Caller, NotFoundError, Services, query_time_ns

_COUNTED = ("opened", "away", "back")
"""Lines of a common alarm's history that count or name robots, also those of others."""

_AROUND_NS = 60 * NS
"""So much before and after an alarm belongs to its window of data."""


def alarm_line(alarm: Alarm, robots: list[RowMapping]) -> AlarmLine:
    """Return an alarm with those of its robots that the caller may see."""
    about = [
        AlarmRobot(robot=r["robot"], from_=format_time(r["from_ns"]), to=maybe_time(r["to_ns"]))
        for r in robots
    ]
    words = decode_words(alarm.words)
    end_ns = None if alarm.cleared_ns is None else alarm.cleared_ns + _AROUND_NS
    window = Window(
        robot=alarm.robot or (about[0].robot if about else ""),
        from_=format_time(max(0, alarm.opened_ns - _AROUND_NS)), to=maybe_time(end_ns),
    )  # fmt: skip
    return AlarmLine(
        id=alarm.number, kind=alarm.kind, robots=about, origin=alarm.origin,
        severity=alarm.severity, level=alarm.level, state=alarm.state, active=alarm.active,
        reason=_reason(alarm, about), cause=alarm.cause, diagnosis=alarm.diagnosis,
        opened=format_time(alarm.opened_ns), changed=format_time(alarm.changed_ns),
        cleared=maybe_time(alarm.cleared_ns), count=alarm.count, late=alarm.late, owner=alarm.owner,
        acknowledged=_acknowledged(alarm), shelved=_shelved(alarm), resolved=_resolved(alarm),
        merged_into=alarm.merged_into, window=window, revision=alarm.revision,
        diagnosis_revision=alarm.revised, explained=words.about(alarm.cause) if words else None,
    )  # fmt: skip


def _reason(alarm: Alarm, about: list[AlarmRobot]) -> str:
    """Return why; of several offline robots only those are named that the caller may see."""
    if alarm.kind == "robot" or alarm.robot:
        return alarm.reason
    away = [one.robot for one in about if one.to is None] or [one.robot for one in about]
    return f"offline: {some_names(away, 5)}"


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


NotificationState = Literal["waiting", "held", "sent", "failed", "digested"]


@dataclass(frozen=True, slots=True)
class Notification:
    """A message to one destination; ``trouble`` is why it has not arrived, ``due`` when next.

    Those that are ``held`` come in one digest, after which they are ``digested``.
    """

    number: int
    destination: str
    kind: Literal["alarm", "acknowledged", "resolved", "digest"]
    alarm: int | None
    severity: str
    state: NotificationState
    subject: str
    created: str
    due: str
    tries: int
    trouble: str
    sent: str | None


def list_alarms(
    fleet: Services, who: Caller, state: Sequence[AlarmState] = (), robot: str = "",
    group: str = "", severity: Severity = "warning", since: str = "", after: int = 0,
    limit: int = 100,
) -> list[AlarmLine]:  # fmt: skip
    """List alarms, the newest first, of the robots that the caller may see.

    With ``since`` only those that have changed since then.
    """
    since_ns = query_time_ns(since, fleet.clock)
    with fleet.database.reading() as connection:
        seen = _seen(connection, who, robot, group)
        wanted = AlarmQuery(seen, state, severity, since_ns, after, limit)
        return _lines(connection, who, store.find_alarms(connection, wanted))


def show_alarm(fleet: Services, who: Caller, id: int) -> AlarmPage:
    """Show an alarm with what suffers from its root, and its history."""
    with fleet.database.reading() as connection:
        return alarm_page(connection, who, find_alarm(connection, who, id))


def find_alarm(connection: Connection, who: Caller, number: int) -> Alarm:
    """Return an alarm; raises NotFoundError also for one of robots that the caller may not see."""
    alarm = AlarmRegister(connection).alarm(number)
    if alarm is None or not _lines(connection, who, [alarm])[0].robots:
        raise NotFoundError("there is no such alarm, or not for you")
    return alarm


def _seen(connection: Connection, who: Caller, robot: str, group: str) -> frozenset[str] | None:
    """Return the robots whose alarms are requested and may be seen; None for all."""
    if who.principal.groups is None and not robot and not group:
        return None
    return frozenset(
        one.id
        for one in who.robots(connection, "alarms.read")
        if robot in ("", one.id) and (not group or group in one.groups)
    )


def _lines(connection: Connection, who: Caller, alarms: list[Alarm]) -> list[AlarmLine]:
    """Return alarms for a list, with those of their robots that the caller may see."""
    mine = _seen(connection, who, "", "")
    robots = store.robots_of(connection, [alarm.number for alarm in alarms])
    return [
        alarm_line(
            alarm, [row for row in robots[alarm.number] if mine is None or row["robot"] in mine]
        )
        for alarm in alarms
    ]


def alarm_page(connection: Connection, who: Caller, alarm: Alarm) -> AlarmPage:
    """Return all of an alarm that the caller may see."""
    return AlarmPage(
        _lines(connection, who, [alarm])[0],
        [
            Consequence(
                component=row["component"], level=row["level"], reason=row["reason"],
                from_=format_time(row["from_ns"]), to=maybe_time(row["to_ns"]),
            )
            for row in store.consequences_of(connection, alarm.number)
        ],
        [
            Happening(format_time(row["at_ns"]), row["who"], row["what"], row["text"])
            for row in store.history_of(connection, alarm.number)
            if alarm.robot or who.principal.groups is None or row["what"] not in _COUNTED
        ],
    )  # fmt: skip


def list_notifications(
    fleet: Services,
    state: NotificationState | None = None,
    alarm: int = 0,
    after: int = 0,
    limit: int = 100,
) -> list[Notification]:
    """List messages that were sent, wait, or failed, the newest first."""
    chosen = select(OUTBOX).order_by(OUTBOX.c.number.desc()).limit(limit)
    chosen = chosen.where(OUTBOX.c.state == state) if state else chosen
    chosen = chosen.where(OUTBOX.c.alarm == alarm) if alarm else chosen
    chosen = chosen.where(OUTBOX.c.number < after) if after else chosen
    with fleet.database.reading() as connection:
        return [
            Notification(
                row.number, row.destination, row.kind, row.alarm or None, row.severity, row.state,
                row.subject, format_time(row.created_ns), format_time(row.due_ns), row.tries,
                row.trouble, maybe_time(row.sent_ns),
            )
            for row in connection.execute(chosen)
        ]  # fmt: skip
