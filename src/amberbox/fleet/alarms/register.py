"""Alarms in the database: find them, keep them, and note what happened to them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any

from sqlalchemy import ColumnElement, Connection, RowMapping, Table, select, update

from amberbox.fleet.alarms.alarm import Alarm, Entry, Part, Step
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT, BLOCKED, HISTORY, PART, ROOTS
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.notifying.followups import note_change

_TEXT = 2_000
_LISTS = frozenset({"blocked_by", "components", "words"})
"""Columns with JSON, of which a part is nothing; who writes them bounds them."""


class Register:
    """The alarms as one transaction sees them; ``touched`` are those that it has changed."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.touched: set[int] = set()

    def alarm(self, number: int) -> Alarm | None:
        """Return an alarm."""
        return next(iter(self.alarms(ALARM.c.number == number)), None)

    def alarms(self, *where: ColumnElement[bool]) -> list[Alarm]:
        """Return the alarms that fit all conditions, oldest first."""
        chosen = select(ALARM).where(*where).order_by(ALARM.c.number)
        return [Alarm(**row) for row in self.connection.execute(chosen).mappings()]

    def newest(self, robot: str, origin: str, kind: str) -> Alarm | None:
        """Return the last alarm of a robot that comes from something."""
        chosen = (
            select(ALARM)
            .where(ALARM.c.robot == robot, ALARM.c.origin == origin, ALARM.c.kind == kind)
            .where(ALARM.c.merged_into.is_(None))
            .order_by(ALARM.c.number.desc())
            .limit(1)
        )
        row = self.connection.execute(chosen).mappings().one_or_none()
        return None if row is None else Alarm(**row)

    def add(self, alarm: Alarm, robots: Iterable[tuple[str, int]], entry: Entry) -> Alarm:
        """Enter a new alarm of robots, each since a time; return it with its number."""
        values = {key: value for key, value in asdict(alarm).items() if key != "number"}
        result = self.connection.execute(ALARM.insert(), _cut(values, ALARM))
        assert result.inserted_primary_key is not None
        number = int(result.inserted_primary_key[0])
        self.add_robots(number, robots)
        self.note(number, [entry])
        return replace(alarm, number=number)

    def add_robots(self, number: int, robots: Iterable[tuple[str, int]]) -> None:
        """Make an alarm about robots that are away, each since a time."""
        rows = [{"alarm": number, "robot": robot, "from_ns": from_ns, "to_ns": None}
                for robot, from_ns in robots]  # fmt: skip
        statement = upsert(
            self.connection.dialect, ALARM_ROBOT, ("alarm", "robot"), ("from_ns", "to_ns")
        )
        self.connection.execute(statement, rows)

    def keep(self, before: Alarm, step: Step) -> Alarm:
        """Keep an alarm after a step, if it is another than before."""
        alarm, entries = step
        if alarm != before:
            values = {key: value for key, value in asdict(alarm).items() if key != "number"}
            statement = update(ALARM).where(ALARM.c.number == alarm.number)
            self.connection.execute(statement.values(**_cut(values, ALARM)))
            self.touched.add(alarm.number)
            note_change(self.connection, before, alarm)
        self.note(alarm.number, entries)
        return alarm

    def note(self, number: int, entries: Sequence[Entry]) -> None:
        """Add to the history of an alarm."""
        rows = [_cut({"alarm": number, **asdict(entry)}, HISTORY) for entry in entries]
        if rows:
            self.connection.execute(HISTORY.insert(), rows)
            self.touched.add(number)

    def part(self, robot: str, source: str) -> Part | None:
        """Return what is known of a robot's own alarm."""
        return next(iter(self._parts(PART.c.robot == robot, PART.c.source == source)), None)

    def parts(self, number: int) -> list[Part]:
        """Return what an alarm is made of, oldest first."""
        return self._parts(PART.c.alarm == number)

    def lasting(self, robot: str) -> list[Part]:
        """Return what lasts of a robot's own alarms."""
        return self._parts(PART.c.robot == robot, PART.c.active)

    def of_component(self, robot: str, component: str) -> list[Part]:
        """Return the parts of alarms that are not resolved and of one component, oldest first."""
        held = select(ALARM.c.number).where(
            ALARM.c.robot == robot, ALARM.c.state != "resolved", ALARM.c.kind == "robot"
        )
        return self._parts(
            PART.c.robot == robot, PART.c.component == component, PART.c.alarm.in_(held)
        )

    def _parts(self, *where: ColumnElement[bool]) -> list[Part]:
        chosen = select(PART).where(*where).order_by(PART.c.opened_ns, PART.c.source)
        return [Part(**row) for row in self.connection.execute(chosen).mappings()]

    def keep_part(self, part: Part) -> None:
        """Keep what a robot said of an alarm of its own."""
        change = [column.name for column in PART.columns if not column.primary_key]
        statement = upsert(self.connection.dialect, PART, ("robot", "source"), change)
        self.connection.execute(statement, [_cut(asdict(part), PART)])

    def move_parts(self, to: int, gone: int) -> None:
        """Make all parts of an alarm those of another."""
        self.connection.execute(update(PART).where(PART.c.alarm == gone).values(alarm=to))

    def roots(self, robot: str, diagnosis: str) -> RowMapping | None:
        """Return what a diagnosis says has failed."""
        chosen = select(ROOTS).where(ROOTS.c.robot == robot, ROOTS.c.diagnosis == diagnosis)
        return self.connection.execute(chosen).mappings().one_or_none()

    def keep_roots(
        self, robot: str, diagnosis: str, revision: int, components: Sequence[str], share: float
    ) -> None:
        """Keep what a diagnosis says has failed, unless a later revision has spoken."""
        row = {"robot": robot, "diagnosis": diagnosis, "revision": revision,
               "components": json.dumps(components), "probability": share}  # fmt: skip
        statement = upsert(
            self.connection.dialect, ROOTS, ("robot", "diagnosis"),
            ("revision", "components", "probability"),
            when=lambda new: new.revision >= ROOTS.c.revision,
        )  # fmt: skip
        self.connection.execute(statement, [_cut(row, ROOTS)])

    def keep_words(self, robot: str, diagnosis: str, effect: str, words: str) -> None:
        """Keep what a diagnosis means in words, if it is known."""
        told = update(ROOTS).where(ROOTS.c.robot == robot, ROOTS.c.diagnosis == diagnosis)
        self.connection.execute(told.values(effect=effect, words=words))

    def blocked(self, robot: str) -> dict[str, RowMapping]:
        """Return the last that is known of each component of a robot."""
        chosen = select(BLOCKED).where(BLOCKED.c.robot == robot)
        return {row["component"]: row for row in self.connection.execute(chosen).mappings()}

    def keep_blocked(self, row: dict[str, Any]) -> None:
        """Keep the last transition of a component."""
        change = [column.name for column in BLOCKED.columns if not column.primary_key]
        statement = upsert(self.connection.dialect, BLOCKED, ("robot", "component"), change)
        self.connection.execute(statement, [_cut(row, BLOCKED)])


def _cut(values: dict[str, Any], table: Table) -> dict[str, Any]:
    """Keep texts as short as their columns: robots may say anything."""
    return {
        name: value.replace("\0", "")[: getattr(table.c[name].type, "length", None) or _TEXT]
        if isinstance(value, str) and name not in _LISTS
        else value
        for name, value in values.items()
    }
