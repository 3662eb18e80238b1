"""Alarms in the database: read and write them with their history, and list matching ones."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from sqlalchemy import ColumnElement, Connection, RowMapping, Table, select, update

from amberbox.core.api import AlarmState
from amberbox.core.robot_status import SEVERITIES, Severity
from amberbox.server.alarms.alarm import Alarm, AlarmPart, HistoryEntry, Step
from amberbox.server.alarms.outbox import note_change
from amberbox.server.database import upsert
from amberbox.server.schema import ALARM, ALARM_ROBOT, BLOCKED, CONSEQUENCE, HISTORY, PART, ROOTS

_TEXT = 2_000
_LISTS = frozenset({"blocked_by", "components", "words"})
"""Columns with JSON, which may be null; their writers bound the size."""


class AlarmRegister:
    """The alarms within one transaction; ``touched`` are the numbers of those it has changed.

    ``commanded`` are the robots for which it has made commands.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.touched: set[int] = set()
        self.commanded: set[str] = set()

    def alarm(self, number: int) -> Alarm | None:
        """Return the alarm with a number; None if there is none."""
        return next(iter(self.alarms(ALARM.c.number == number)), None)

    def alarms(self, *where: ColumnElement[bool]) -> list[Alarm]:
        """Return the alarms that fit all conditions, oldest first."""
        chosen = select(ALARM).where(*where).order_by(ALARM.c.number)
        return [Alarm(**row) for row in self.connection.execute(chosen).mappings()]

    def newest(self, robot: str, origin: str, kind: str) -> Alarm | None:
        """Return the last alarm of a robot with this origin and kind, merged ones left out."""
        chosen = (
            select(ALARM)
            .where(ALARM.c.robot == robot, ALARM.c.origin == origin, ALARM.c.kind == kind)
            .where(ALARM.c.merged_into.is_(None))
            .order_by(ALARM.c.number.desc())
            .limit(1)
        )
        row = self.connection.execute(chosen).mappings().one_or_none()
        return None if row is None else Alarm(**row)

    def add(self, alarm: Alarm, robots: Iterable[tuple[str, int]], entry: HistoryEntry) -> Alarm:
        """Insert a new alarm of robots, each since a time (ns); return it with its number."""
        values = {key: value for key, value in asdict(alarm).items() if key != "number"}
        result = self.connection.execute(ALARM.insert(), _cut(values, ALARM))
        assert result.inserted_primary_key is not None
        number = int(result.inserted_primary_key[0])
        self.add_robots(number, robots)
        self.note(number, [entry])
        return replace(alarm, number=number)

    def add_robots(self, number: int, robots: Iterable[tuple[str, int]]) -> None:
        """Add robots that are away, each since a time (ns), to an alarm."""
        rows = [{"alarm": number, "robot": robot, "from_ns": from_ns, "to_ns": None}
                for robot, from_ns in robots]  # fmt: skip
        statement = upsert(
            self.connection.dialect, ALARM_ROBOT, ("alarm", "robot"), ("from_ns", "to_ns")
        )
        self.connection.execute(statement, rows)

    def keep(self, before: Alarm, step: Step) -> Alarm:
        """Store an alarm after a step, and the entries of its history; return it."""
        alarm, entries = step
        if alarm != before:
            values = {key: value for key, value in asdict(alarm).items() if key != "number"}
            statement = update(ALARM).where(ALARM.c.number == alarm.number)
            self.connection.execute(statement.values(**_cut(values, ALARM)))
            self.touched.add(alarm.number)
            note_change(self.connection, before, alarm)
        self.note(alarm.number, entries)
        return alarm

    def note(self, number: int, entries: Sequence[HistoryEntry]) -> None:
        """Add entries to the history of an alarm."""
        rows = [_cut({"alarm": number, **asdict(entry)}, HISTORY) for entry in entries]
        if rows:
            self.connection.execute(HISTORY.insert(), rows)
            self.touched.add(number)

    def part(self, robot: str, source: str) -> AlarmPart | None:
        """Return the part for a robot's own alarm; None if there is none."""
        return next(iter(self._parts(PART.c.robot == robot, PART.c.source == source)), None)

    def parts(self, number: int) -> list[AlarmPart]:
        """Return the parts of an alarm, oldest first."""
        return self._parts(PART.c.alarm == number)

    def lasting(self, robot: str) -> list[AlarmPart]:
        """Return the active parts of a robot."""
        return self._parts(PART.c.robot == robot, PART.c.active)

    def of_component(self, robot: str, component: str) -> list[AlarmPart]:
        """Return the parts of a component in unresolved alarms, oldest first."""
        held = select(ALARM.c.number).where(
            ALARM.c.robot == robot, ALARM.c.state != "resolved", ALARM.c.kind == "robot"
        )
        return self._parts(
            PART.c.robot == robot, PART.c.component == component, PART.c.alarm.in_(held)
        )

    def _parts(self, *where: ColumnElement[bool]) -> list[AlarmPart]:
        chosen = select(PART).where(*where).order_by(PART.c.opened_ns, PART.c.source)
        return [AlarmPart(**row) for row in self.connection.execute(chosen).mappings()]

    def keep_part(self, part: AlarmPart) -> None:
        """Store the state of a robot's own alarm."""
        change = [column.name for column in PART.columns if not column.primary_key]
        statement = upsert(self.connection.dialect, PART, ("robot", "source"), change)
        self.connection.execute(statement, [_cut(asdict(part), PART)])

    def move_parts(self, to: int, gone: int) -> None:
        """Move all parts of alarm ``gone`` to alarm ``to``."""
        self.connection.execute(update(PART).where(PART.c.alarm == gone).values(alarm=to))

    def roots(self, robot: str, diagnosis: str) -> RowMapping | None:
        """Return the failed components by a diagnosis; None if none are stored."""
        chosen = select(ROOTS).where(ROOTS.c.robot == robot, ROOTS.c.diagnosis == diagnosis)
        return self.connection.execute(chosen).mappings().one_or_none()

    def keep_roots(
        self, robot: str, diagnosis: str, revision: int, components: Sequence[str], share: float
    ) -> None:
        """Store the failed components by a diagnosis, unless a later revision is stored."""
        row = {"robot": robot, "diagnosis": diagnosis, "revision": revision,
               "components": json.dumps(components), "probability": share}  # fmt: skip
        statement = upsert(
            self.connection.dialect, ROOTS, ("robot", "diagnosis"),
            ("revision", "components", "probability"),
            when=lambda new: new.revision >= ROOTS.c.revision,
        )  # fmt: skip
        self.connection.execute(statement, [_cut(row, ROOTS)])

    def keep_words(self, robot: str, diagnosis: str, effect: str, words: str) -> None:
        """Store the effect and the explanation of a diagnosis, if its row exists."""
        changed = update(ROOTS).where(ROOTS.c.robot == robot, ROOTS.c.diagnosis == diagnosis)
        self.connection.execute(changed.values(effect=effect, words=words))

    def blocked(self, robot: str) -> dict[str, RowMapping]:
        """Return the last transition of each component of a robot, by component."""
        chosen = select(BLOCKED).where(BLOCKED.c.robot == robot)
        return {row["component"]: row for row in self.connection.execute(chosen).mappings()}

    def keep_blocked(self, row: dict[str, Any]) -> None:
        """Store the last transition of a component."""
        change = [column.name for column in BLOCKED.columns if not column.primary_key]
        statement = upsert(self.connection.dialect, BLOCKED, ("robot", "component"), change)
        self.connection.execute(statement, [_cut(row, BLOCKED)])


def _cut(values: dict[str, Any], table: Table) -> dict[str, Any]:
    """Cut texts to the length of their columns, without NUL; robots may send any text."""
    return {
        name: value.replace("\0", "")[: getattr(table.c[name].type, "length", None) or _TEXT]
        if isinstance(value, str) and name not in _LISTS
        else value
        for name, value in values.items()
    }


_MOST = 1_000


@dataclass(frozen=True, slots=True)
class AlarmQuery:
    """Filter of a list of alarms; empty fields match all, ``robots=None`` is all robots."""

    robots: frozenset[str] | None = None
    states: Collection[AlarmState] = ()
    least: Severity = "warning"
    since_ns: int | None = None
    after: int = 0
    limit: int = 100


def find_alarms(connection: Connection, wanted: AlarmQuery) -> list[Alarm]:
    """Return alarms, newest first; those merged into another are left out.

    ``after`` is the number of the last alarm of the previous page.
    """
    where: list[ColumnElement[bool]] = [
        ALARM.c.merged_into.is_(None),
        ALARM.c.severity.in_(SEVERITIES[SEVERITIES.index(wanted.least) :]),
    ]
    if wanted.states:
        where.append(ALARM.c.state.in_(sorted(wanted.states)))
    if wanted.since_ns is not None:
        where.append(ALARM.c.changed_ns >= wanted.since_ns)
    if wanted.after:
        where.append(ALARM.c.number < wanted.after)
    if wanted.robots is not None:
        of = select(ALARM_ROBOT.c.alarm).where(ALARM_ROBOT.c.robot.in_(sorted(wanted.robots)))
        where.append(ALARM.c.number.in_(of))
    chosen = select(ALARM).where(*where).order_by(ALARM.c.number.desc()).limit(wanted.limit)
    return [Alarm(**row) for row in connection.execute(chosen).mappings()]


def robots_of(connection: Connection, numbers: Sequence[int]) -> dict[int, list[RowMapping]]:
    """Return the robots of alarms, by number: rows of robot, from_ns, to_ns."""
    found: dict[int, list[RowMapping]] = {number: [] for number in numbers}
    chosen = select(ALARM_ROBOT).where(ALARM_ROBOT.c.alarm.in_(list(numbers)))
    for row in connection.execute(chosen.order_by(ALARM_ROBOT.c.robot)).mappings():
        found[row["alarm"]].append(row)
    return found


def consequences_of(connection: Connection, number: int) -> list[RowMapping]:
    """Return the components that suffer or suffered from the root of an alarm, oldest first."""
    chosen = select(CONSEQUENCE).where(CONSEQUENCE.c.alarm == number)
    ordered = chosen.order_by(CONSEQUENCE.c.from_ns, CONSEQUENCE.c.component)
    return list(connection.execute(ordered).mappings())


def history_of(connection: Connection, number: int) -> list[RowMapping]:
    """Return the history of an alarm, oldest first; the newest 1000 entries at most."""
    chosen = select(HISTORY).where(HISTORY.c.alarm == number).order_by(HISTORY.c.number.desc())
    return list(connection.execute(chosen.limit(_MOST)).mappings())[::-1]
