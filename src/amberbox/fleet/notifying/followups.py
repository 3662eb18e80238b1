"""Tell destinations that ask for it what became of an alarm: acknowledged, resolved, open again.

A change of an alarm is noted (``note_change``) in its own transaction and looked at later
(``follow_up``): what a destination was told last, by the outbox, is compared with how the alarm
stands. So nothing is told twice, and nothing of an alarm that a destination was never told of.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from sqlalchemy import Connection, RowMapping, delete, select

from amberbox.fleet.alarms.alarm import Alarm
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.notifying.message import Event
from amberbox.fleet.notifying.outbox import Telling, enter
from amberbox.fleet.notifying.settings import Destination, Notifications
from amberbox.fleet.notifying.tables import CHANGED, OUTBOX

_AT_ONCE: Final = 50
FindAlarm: TypeAlias = Callable[[int], "Alarm | None"]


@dataclass(frozen=True, slots=True)
class _Thread:
    """What one destination was told of one alarm: messages that arrived or are on their way."""

    rows: Sequence[RowMapping]

    @property
    def last(self) -> Literal["", "alarm", "acknowledged", "resolved"]:
        """The kind of the last message; empty if there was none."""
        kind: Literal["", "alarm", "acknowledged", "resolved"]
        kind = self.rows[-1]["kind"] if self.rows else ""
        return kind

    @property
    def robots(self) -> list[str]:
        """The robots that the destination was told of."""
        return list(json.loads(self.rows[-1]["data"])["robots"])

    @property
    def has_flapped(self) -> bool:
        """Whether the alarm was told as resolved before."""
        return any(row["kind"] == "resolved" for row in self.rows)


def note_change(connection: Connection, before: Alarm, after: Alarm) -> None:
    """Note, in the transaction of the change, that an alarm's state is another now."""
    if after.state != before.state and (before.told or after.told):
        _look(connection, after.number, 0)


def is_due(connection: Connection, now_ns: int) -> bool:
    """Tell whether a change of an alarm has to be looked at."""
    chosen = select(CHANGED.c.alarm).where(CHANGED.c.due_ns <= now_ns).limit(1)
    return connection.execute(chosen).first() is not None


def follow_up(
    connection: Connection,
    find: FindAlarm,
    now_ns: int,
    stays_ns: int,
    setting: Notifications,
    url: str,
) -> None:
    """Put messages about changed alarms into the outbox, for destinations that ask for them.

    An alarm that was resolved, came back, and is resolved again by itself is told as resolved once
    it has stayed so for ``stays_ns``.
    """
    chosen = select(CHANGED.c.alarm).where(CHANGED.c.due_ns <= now_ns).order_by(CHANGED.c.alarm)
    for number in connection.execute(chosen.limit(_AT_ONCE)).scalars().all():
        connection.execute(delete(CHANGED).where(CHANGED.c.alarm == number))
        alarm = find(number)
        if alarm is None:
            continue
        for to in (one for one in setting.destinations() if one.also):
            thread = _thread(connection, to.name, number)
            wait_ns = _wait_ns(alarm, thread, stays_ns)
            if wait_ns > now_ns:
                _look(connection, number, wait_ns)
                continue
            for about, event, robots in _untold(connection, find, to, alarm, thread):
                enter(connection, to, Telling(about, robots, event), now_ns, setting, url)


def _look(connection: Connection, number: int, due_ns: int) -> None:
    statement = upsert(connection.dialect, CHANGED, ("alarm",), ("due_ns",))
    connection.execute(statement, [{"alarm": number, "due_ns": due_ns}])


def _thread(connection: Connection, destination: str, number: int) -> _Thread:
    chosen = (
        select(OUTBOX)
        .where(
            OUTBOX.c.alarm == number,
            OUTBOX.c.destination == destination,
            OUTBOX.c.state != "failed",
        )
        .order_by(OUTBOX.c.number)
    )
    return _Thread(connection.execute(chosen).mappings().all())


def _wait_ns(alarm: Alarm, thread: _Thread, stays_ns: int) -> int:
    """Return until when nothing is told of an alarm that flaps; 0 for one that does not."""
    by_itself = alarm.state == "resolved" and not alarm.resolved_by and alarm.merged_into is None
    if not (by_itself and thread.has_flapped) or thread.last == "resolved":
        return 0
    return (alarm.resolved_ns or 0) + stays_ns


def _untold(
    connection: Connection, find: FindAlarm, to: Destination, alarm: Alarm, thread: _Thread
) -> Iterator[tuple[Alarm, Event, list[str]]]:
    """Yield what a destination has to be told: alarm, event, robots; in this order."""
    if not thread.rows:
        return
    robots = thread.robots
    if alarm.state == "resolved" and "resolved" in to.also and thread.last != "resolved":
        keep = find(alarm.merged_into) if alarm.merged_into is not None else None
        lasts = keep is not None and keep.state != "resolved"
        if keep is not None and lasts and not _thread(connection, to.name, keep.number).rows:
            yield keep, "opened", robots  # else its receiver would take it for over
        yield alarm, "resolved", robots
    if alarm.state in ("open", "acknowledged") and thread.last == "resolved":
        yield alarm, "opened", robots
    is_acknowledged = alarm.state == "acknowledged" and thread.last != "acknowledged"
    if is_acknowledged and "acknowledged" in to.also:
        yield alarm, "acknowledged", robots
