"""What the server wrote down beside the recordings goes with them: by the same rules, once a day.

Never goes: how a component was last, what happened to an alarm that is not resolved, and of each
store the last signed head from before what is still kept: it covers all that came before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import Connection, Table, delete, exists, func, select, tuple_

from amberbox.core.clock import NS
from amberbox.fleet.alarms.tables import ALARM, ALARM_ROBOT, HISTORY
from amberbox.fleet.archive.retaining import DATA, rule_of
from amberbox.fleet.archive.store import OWN, Retention
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.tables import EVENT, HEADS

AT_ONCE = 500
"""Rows in one transaction: others want to write, too."""


def forget(database: Database, rules: Sequence[Retention], now_ns: int) -> int:
    """Remove what is older than the rules for the recordings it belongs to; return how many rows.

    What was noticed of a link, and what happened to alarms, go as what the box itself says; signed
    heads as the journals of data that they speak of.
    """
    with database.reading() as connection:
        gone: dict[Table, list[tuple[Any, ...]]] = {
            EVENT: [(number,) for number in _events(connection, rules, now_ns)],
            HISTORY: [(number,) for number in _history(connection, rules, now_ns)],
            HEADS: list(_heads(connection, rules, now_ns)),
        }
    for table, keys in gone.items():
        _remove(database, table, keys)
    return sum(len(keys) for keys in gone.values())


def _remove(database: Database, table: Table, keys: Sequence[tuple[Any, ...]]) -> None:
    key = tuple_(*table.primary_key.columns)
    for some in _parts(keys):
        with database.begin() as connection:
            connection.execute(delete(table).where(key.in_(some)))


def _parts(keys: Sequence[tuple[Any, ...]]) -> Iterator[Sequence[tuple[Any, ...]]]:
    for start in range(0, len(keys), AT_ONCE):
        yield keys[start : start + AT_ONCE]


def _events(connection: Connection, rules: Sequence[Retention], now_ns: int) -> Iterator[int]:
    for robot in connection.scalars(select(EVENT.c.robot).distinct()).all():
        before_ns = _noted_before(robot, rules, now_ns)
        if before_ns is not None:
            old = select(EVENT.c.number).where(EVENT.c.robot == robot, EVENT.c.at_ns < before_ns)
            yield from connection.scalars(old)


def _history(connection: Connection, rules: Sequence[Retention], now_ns: int) -> Iterator[int]:
    """Yield the lines of alarms that were resolved so long ago, for all of their robots."""
    told = exists().where(HISTORY.c.alarm == ALARM.c.number)
    resolved = select(ALARM.c.number, ALARM.c.resolved_ns).where(
        ALARM.c.state == "resolved", ALARM.c.resolved_ns.is_not(None), told
    )
    for alarm, resolved_ns in connection.execute(resolved).all():
        about = select(ALARM_ROBOT.c.robot).where(ALARM_ROBOT.c.alarm == alarm)
        befores = [_noted_before(one, rules, now_ns) for one in connection.scalars(about)]
        if befores and all(ns is not None and resolved_ns < ns for ns in befores):
            yield from connection.scalars(select(HISTORY.c.number).where(HISTORY.c.alarm == alarm))


def _heads(
    connection: Connection, rules: Sequence[Retention], now_ns: int
) -> Iterator[tuple[str, str, str]]:
    stores = select(HEADS.c.robot, HEADS.c.store_id).distinct()
    for robot, store_id in connection.execute(stores).all():
        before_ns = _signed_before(robot, rules, now_ns)
        if before_ns is None:
            continue
        old = (HEADS.c.robot == robot, HEADS.c.store_id == store_id, HEADS.c.at_ns < before_ns)
        last_ns = connection.scalar(select(func.max(HEADS.c.at_ns)).where(*old))
        keys = select(*HEADS.primary_key.columns).where(*old, HEADS.c.at_ns < last_ns)
        yield from (tuple(row) for row in connection.execute(keys))


def _noted_before(robot: str, rules: Sequence[Retention], now_ns: int) -> int | None:
    rule = rule_of(robot, OWN, rules)
    if rule is None or rule.columns_s is None:
        return None
    return now_ns - int(rule.columns_s * NS)


def _signed_before(robot: str, rules: Sequence[Retention], now_ns: int) -> int | None:
    """Return before when no journal of data is kept; None where some are for ever."""
    found = [rule_of(robot, keeping, rules) for keeping in DATA]
    lasts = [None if rule is None else rule.journals_s for rule in found]
    kept = [seconds for seconds in lasts if seconds is not None]
    return now_ns - int(max(kept) * NS) if len(kept) == len(DATA) else None
