"""Robots that are away: seen, missed after a while, excused, lost together, back again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Output, Status
from amberbox.server.accounts.robots import disable_robot
from amberbox.server.alarms.alarm import AlarmSettings, Shared
from tests.server.alarms.stand import Stand, stand

FLEET = [f"robot_{number:03}" for number in range(100)]


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        one.alarms.step()
        yield one


def status(home: Stand, robot: str, component: str, **outputs: Output) -> None:
    now_ns = home.clock.wall_ns()
    said = Status(robot, component, "m", "ok", "nominal", outputs, (), now_ns, now_ns, "", "hash")
    home.send(robot, home.rows(robot, [said]))


def test_one_that_is_away_is_missed_after_a_while_and_comes_back(home: Stand) -> None:
    home.lose("r1")
    home.wait(119)
    assert home.found() == []
    home.wait(2)
    one = home.only()
    assert (one.kind, one.robot, one.origin, one.severity) == (
        "offline", "r1", "connection", "urgent",
    )  # fmt: skip
    assert [message.subject for _, message in home.told] == ["urgent: r1 connection"]
    home.wait(600, 30)
    home.connect("r1")
    home.wait(30)
    assert (home.only().active, home.only().state) == (False, "open")
    home.wait(34)
    assert home.only().state == "resolved"
    assert len(home.told) == 1


def test_one_that_comes_back_in_time_was_never_missed(home: Stand) -> None:
    for _ in range(5):
        home.lose("r1")
        home.wait(100, 10)
        home.connect("r1")
        home.wait(20, 10)
    assert home.found() == []


def test_away_again_soon_is_the_same_alarm(home: Stand) -> None:
    for _ in range(3):
        home.lose("r1")
        home.wait(130, 10)
        home.connect("r1")
        home.wait(70, 10)
    assert (home.only().count, home.only().state) == (3, "resolved")
    assert len(home.told) == 1


@pytest.mark.parametrize(
    ("component", "output", "value", "missed"),
    [
        ("battery", "docked", True, False),
        ("battery", "docked", False, True),
        ("battery", "docked", None, True),
        ("wifi", "in_coverage", False, False),
        ("wifi", "in_coverage", True, True),
    ],
)
def test_docked_or_outside_coverage_it_is_not_missed(
    home: Stand, component: str, output: str, value: Output, missed: bool
) -> None:
    status(home, "r1", component, **{output: value})
    home.lose("r1")
    home.wait(300, 10)
    assert bool(home.found()) is missed


def test_it_is_missed_when_it_goes_again_without_an_excuse(home: Stand) -> None:
    status(home, "r1", "battery", docked=True)
    home.lose("r1")
    home.wait(300, 10)
    home.connect("r1")
    status(home, "r1", "battery", docked=False)
    home.lose("r1")
    home.wait(130, 10)
    assert len(home.found()) == 1


def test_times_can_be_set_by_group_and_by_robot(home: Stand) -> None:
    home.group("depot")
    home.add(["r2", "r3"], ["depot"])
    home.connect("r2", "r3")
    home.set("alarms", AlarmSettings(offline_after_of={"depot": 0, "r3": 20}))
    home.lose("r1", "r2", "r3")
    home.wait(30)
    assert home.only().robot == "" or home.only().robot == "r3"
    home.wait(300, 10)
    assert all("r2" not in one.reason for one in home.found())


def test_a_robot_that_was_disabled_is_not_missed(home: Stand) -> None:
    with home.database.begin() as connection:
        disable_robot(connection, home.clock.wall_ns(), "r1")
    home.lose("r1")
    home.wait(200, 10)
    assert home.found() == []


def fleet(home: Stand, access_point: str = "ap-3") -> None:
    home.group("ward")
    home.add(FLEET, ["ward"])
    home.connect(*FLEET)
    for robot in FLEET:
        status(home, robot, "wifi", access_point=access_point)


def test_the_loss_of_an_access_point_is_one_alarm(home: Stand) -> None:
    fleet(home)
    for robot in FLEET[:50]:
        home.lose(robot)
        home.clock.advance(0.19)
    home.wait(300, 5)
    one = home.only()
    assert (one.robot, one.origin, one.severity) == ("", "access point ap-3", "critical")
    assert one.reason.startswith("50 robots are offline, all of access point ap-3: robot_000")
    assert len(home.told) == 1
    assert len(home.told[0][1].data["robots"]) == 50
    home.connect(*FLEET[:49])
    home.wait(70, 5)
    assert (home.only().active, home.only().state) == (True, "open")
    home.connect(FLEET[49])
    home.wait(70, 5)
    assert home.only().state == "resolved"


def test_what_they_share_is_a_group_or_else_the_connection(home: Stand) -> None:
    home.set("alarms", AlarmSettings(shared=(Shared("switch", "*/*/switch"),)))
    fleet(home)
    home.lose(*FLEET[:3])
    home.wait(130, 5)
    home.lose("r1", *FLEET[50:52])
    home.wait(130, 5)
    assert [one.origin for one in home.found()] == ["group ward", "connection"]


def test_those_lost_later_are_another_alarm(home: Stand) -> None:
    home.add(["r2"])
    home.connect("r2")
    home.lose("r1")
    home.clock.advance(11)
    home.lose("r2")
    home.wait(200, 5)
    assert [one.robot for one in home.found()] == ["r1", "r2"]


def test_a_restart_of_the_server_with_100_robots_is_no_alarm(home: Stand) -> None:
    fleet(home)
    home.wait(3)
    home.clock.advance(3600)  # it was down for an hour
    home.restart()
    for number, robot in enumerate(FLEET):
        if number % 4 == 0:
            home.wait(1)
        home.connect(robot)
    home.connect("r1")
    home.wait(600, 10)
    assert home.found() == []


def test_who_stays_away_after_a_restart_is_missed(home: Stand) -> None:
    home.clock.advance(3600)
    home.restart()
    home.alarms.step()
    home.wait(119)
    assert home.found() == []
    home.wait(2)
    assert home.only().opened_ns == home.clock.wall_ns() - 121 * NS
    home.restart()
    home.wait(300, 10)
    assert len(home.found()) == len(home.told) == 1
    home.connect("r1")
    home.wait(70, 10)
    assert home.only().state == "resolved"


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 86_400.0 * 400])
def test_a_step_of_the_servers_clock_neither_raises_nor_clears(home: Stand, step_s: float) -> None:
    home.lose("r1")
    home.wait(60)
    home.clock.step(step_s)
    home.wait(40)
    assert home.found() == [], "away for 100 s, whatever the wall clock says"
    home.wait(30)
    (alarm,) = home.found()
    now_ns = home.clock.wall_ns()
    assert now_ns - 131 * NS <= alarm.opened_ns <= now_ns, "told by the clock as it is now"
    assert len(home.told) == 1
    home.connect("r1")
    home.wait(10)
    home.clock.step(step_s)
    home.wait(40)
    assert (home.only().active, home.only().state) == (False, "open"), "quiet for 50 s"
    home.wait(15)
    assert home.only().state == "resolved"
    home.clock.step(step_s)
    home.lose("r1")
    home.wait(130)
    assert (home.only().count, home.only().active) == (2, True), "away again soon"
