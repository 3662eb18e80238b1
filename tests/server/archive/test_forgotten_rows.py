"""The server's records beside recordings are deleted by the rules; the newest ones stay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.core.api import AlarmState
from amberbox.core.clock import NS
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.archive import retention
from amberbox.server.archive.retention import forget_old_rows
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_state import keep_heads, log_event
from amberbox.server.journals import OWN, Retention
from amberbox.server.schema import ALARM, ALARM_ROBOT, EVENT, HEADS, HISTORY
from amberbox.testing.clock import ManualClock

DAY_NS = 24 * 3600 * NS
DAY_S = 86_400.0
NOW_NS = 1000 * DAY_NS
OWN_30 = Retention(keeping=OWN, columns_s=30 * DAY_S)
DATA_30 = Retention(journals_s=30 * DAY_S)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ServerDatabase]:
    found = ServerDatabase(tmp_path / "server.db", ManualClock())
    yield found
    found.close()


def days_ago(days: float) -> int:
    return NOW_NS - int(days * DAY_NS)


def noted(database: ServerDatabase) -> list[str]:
    with database.reading() as connection:
        return list(connection.scalars(select(EVENT.c.text).order_by(EVENT.c.number)))


def note_all(database: ServerDatabase) -> None:
    with database.begin() as connection:
        for robot, days in (("r1", 31), ("r1", 29), ("r2", 31), ("", 31)):
            log_event(connection, robot, days_ago(days), "connected", f"{robot} {days}")


def test_without_rules_nothing_goes(database: ServerDatabase) -> None:
    note_all(database)
    assert forget_old_rows(database, (), NOW_NS) == 0
    assert len(noted(database)) == 4


def test_what_was_noticed_goes_as_what_the_box_says(database: ServerDatabase) -> None:
    note_all(database)
    assert forget_old_rows(database, [DATA_30], NOW_NS) == 0  # a rule for data is none for this
    rules = [OWN_30, Retention("r2", OWN, columns_s=None)]
    assert forget_old_rows(database, rules, NOW_NS) == 2
    assert noted(database) == ["r1 29", "r2 31"]


def test_many_rows_go_in_several_transactions(
    database: ServerDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retention, "AT_ONCE", 2)
    with database.begin() as connection:
        for number in range(5):
            log_event(connection, "r1", days_ago(40), "connected", str(number))
    assert forget_old_rows(database, [OWN_30], NOW_NS) == 5
    assert noted(database) == []


def add_alarm(
    database: ServerDatabase, number: int, state: AlarmState, days: float, *robots: str
) -> None:
    at_ns = days_ago(days)
    resolved_ns = at_ns if state == "resolved" else None
    alarm = Alarm(number, "robot", robots[0], "laser", "urgent", "error", "dead", at_ns, at_ns,
                  state=state, resolved_ns=resolved_ns)  # fmt: skip
    with database.begin() as connection:
        connection.execute(ALARM.insert(), [asdict(alarm)])
        about = {"alarm": number, "from_ns": at_ns, "to_ns": None}
        connection.execute(ALARM_ROBOT.insert(), [{**about, "robot": robot} for robot in robots])
        line = {"alarm": number, "at_ns": at_ns, "who": "", "what": "opened", "text": ""}
        connection.execute(HISTORY.insert(), [line, {**line, "what": "note"}])


def test_the_history_of_an_alarm_goes_when_it_was_resolved_long_ago(
    database: ServerDatabase,
) -> None:
    add_alarm(database, 1, "resolved", 31, "r1")
    add_alarm(database, 2, "resolved", 29, "r1")
    add_alarm(database, 3, "open", 400, "r1")
    add_alarm(database, 4, "acknowledged", 400, "r1")
    add_alarm(database, 5, "resolved", 31, "r1", "r2")
    rules = [OWN_30, Retention("r2", OWN, columns_s=60 * DAY_S)]
    assert forget_old_rows(database, rules, NOW_NS) == 2
    assert forget_old_rows(database, rules, NOW_NS) == 0
    with database.reading() as connection:
        kept = set(connection.scalars(select(HISTORY.c.alarm)))
        assert kept == {2, 3, 4, 5}
        assert len(connection.execute(select(ALARM)).all()) == 5


def heads_of(database: ServerDatabase) -> list[bytes]:
    with database.reading() as connection:
        return list(connection.scalars(select(HEADS.c.heads).order_by(HEADS.c.at_ns)))


def test_signed_heads_go_with_the_journals_but_for_the_last_before_them(
    database: ServerDatabase,
) -> None:
    with database.begin() as connection:
        for days in (50, 40, 31, 29, 1):
            keep_heads(connection, "r1", "s1", f"s1 {days}".encode(), days_ago(days))
        keep_heads(connection, "r1", "s0", b"s0 900", days_ago(900))
    assert forget_old_rows(database, [Retention(keeping="main", journals_s=DAY_S)], NOW_NS) == 0
    assert forget_old_rows(database, [DATA_30], NOW_NS) == 2
    assert heads_of(database) == [b"s0 900", b"s1 31", b"s1 29", b"s1 1"]
    longer = [Retention(keeping="ring", journals_s=None), DATA_30]
    assert forget_old_rows(database, longer, NOW_NS + 300 * DAY_NS) == 0
