"""Alarms of the time while a robot was offline are listed, without notifications."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.link.frames import LinkRow
from tests.server.alarms.stand import EARLIER, START_NS, Stand, alarm, stand

HOURS_8 = 8 * 3600 * NS


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        one.alarms.step()
        yield one


def night(home: Stand, transitions: int, apart_ns: int) -> list[LinkRow]:
    """Make what a robot wrote in 8 hours: alarms that open and heal, of several components."""
    rows: list[LinkRow] = []
    for number in range(transitions):
        at_ns = START_NS + number * apart_ns
        opened_ns = at_ns - (number % 2) * apart_ns
        component = ("laser", "wifi", "battery")[number // 2 % 3]
        said = alarm(
            home, component, "healed" if number % 2 else "open", severity="critical",
            source=f"{component}-{number // 2}", opened_ns=opened_ns, changed_ns=at_ns,
        )  # fmt: skip
        rows += home.rows("r1", [said], at_ns)
    return rows


def test_8_hours_of_backlog_notify_nobody(home: Stand) -> None:
    rows = night(home, 300, HOURS_8 // 300)
    home.lose("r1")
    home.clock.advance(8 * 3600)
    home.connect("r1")
    for first in range(0, len(rows), 30):
        home.send("r1", rows[first : first + 30])
        home.wait(2)
    home.wait(600, 10)
    robot = [one for one in home.found() if one.kind == "robot"]
    assert len(robot) > 3 and sum(one.count for one in robot) == 150
    assert all(one.late and one.state == "resolved" for one in robot)
    assert all(one.opened_ns < START_NS + HOURS_8 for one in robot)
    assert home.told == [] and home.outbox() == []


def test_what_still_lasts_when_the_past_is_told_is_told_once(home: Stand) -> None:
    rows = night(home, 101, HOURS_8 // 300)
    home.lose("r1")
    home.clock.advance(8 * 3600)
    home.connect("r1")
    home.send("r1", rows[:50])
    home.wait(5)
    home.send("r1", rows[50:])
    home.wait(8)
    assert home.told == []
    home.wait(5)
    ((_, message),) = home.told
    assert "the robot was offline when it happened" in message.body


def test_what_opened_offline_and_healed_since_is_not_told(home: Stand) -> None:
    opened_ns = home.clock.wall_ns()
    rows = home.rows("r1", [alarm(home)], opened_ns)
    home.lose("r1")
    home.clock.advance(600)
    home.connect("r1")
    healed = home.rows("r1", [alarm(home, state="healed", opened_ns=opened_ns)])
    home.send("r1", healed)  # what is new comes first
    home.send("r1", rows)
    home.wait(60)
    assert home.told == [] and not home.only().active


def test_a_clock_that_is_wrong_is_no_delay(home: Stand) -> None:
    home.connect("r1", behind_s=50 * 365 * 86_400, boot=EARLIER)
    at_ns = home.clock.wall_ns() - 50 * 365 * 86_400 * NS
    home.send("r1", home.rows("r1", [alarm(home, opened_ns=at_ns, changed_ns=at_ns)], at_ns))
    home.wait(12)
    assert len(home.told) == 1 and not home.only().late


def test_it_is_told_when_it_comes_back_live(home: Stand) -> None:
    at_ns = home.clock.wall_ns()
    rows = home.rows("r1", [alarm(home), alarm(home, state="healed")], at_ns)
    home.lose("r1")
    home.clock.advance(100)
    home.connect("r1")
    home.send("r1", rows)
    home.wait(80)
    assert home.only().state == "resolved" and home.told == []
    home.say("r1", alarm(home, count=2))
    home.wait(12)
    assert len(home.told) == 1 and not home.only().late


def test_a_team_that_is_watched_on_the_server_goes_by_its_clock(home: Stand) -> None:
    home.hear("team_1", alarm(home, state="open"))
    home.alarms.step()
    home.hear("team_1", alarm(home, state="healed"))
    home.wait(12)
    assert len(home.told) == 1 and not home.only().late
