"""Robots that fall silent while their link holds, and how old statuses are that only repeat."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.link import limits
from amberbox.link.server_end import ServerEnd
from amberbox.server.ingest.link_server import QUIET_S, RobotConnection
from amberbox.server.live.feed import SilenceMonitor, ages_data
from amberbox.server.live.records import RetainedStatus, ServerNow, StatusRecord, format_moment
from tests.server.house import house
from tests.server.live.listening import ask, hear, stage
from tests.support.sockets import FakeSocket

SEEN_NS = 1_800_000_000 * NS


def connected(heard_s_ago: float) -> RobotConnection:
    one = RobotConnection("ropod_001", FakeSocket(), ServerEnd("ropod_001"), SEEN_NS)
    one.last_received_s = time.monotonic() - heard_s_ago
    return one


def test_three_missed_heartbeats_are_silence_before_the_link_is_dead() -> None:
    assert 3 * limits.BEAT_S < QUIET_S < limits.SILENT_S


def test_a_robot_that_misses_its_heartbeats_is_told_of_once_and_again_when_it_is_heard() -> None:
    silence = SilenceMonitor()
    robots = {"ropod_001": connected(QUIET_S - 0.5)}
    assert list(silence.news(robots)) == []
    robots["ropod_001"].last_received_s -= 1
    said = {"online": True, "silent": True, "since": format_moment(SEEN_NS)}
    assert list(silence.news(robots)) == [("ropod_001", said)]
    assert list(silence.news(robots)) == []
    robots["ropod_001"].last_received_s = time.monotonic()
    assert list(silence.news(robots)) == [("ropod_001", {"online": True})]


def test_of_a_silent_robot_whose_link_ends_nothing_more_is_told() -> None:
    silence = SilenceMonitor()
    assert list(silence.news({"ropod_001": connected(QUIET_S + 1)}))
    assert list(silence.news({})) == []


def test_a_watcher_that_falls_silent_is_told_of_once_and_again_when_it_is_heard() -> None:
    silence, robots = SilenceMonitor(), {"ropod_001": connected(0)}
    quiet = frozenset({"ropod_001", "ropod_002"})  # the other one is away
    assert list(silence.watchers(robots, frozenset())) == []
    assert list(silence.watchers(robots, quiet)) == [("ropod_001", {"online": True})]
    assert list(silence.watchers(robots, quiet)) == []
    assert list(silence.watchers(robots, frozenset())) == [("ropod_001", {"online": True})]


def standing(measured_s: float, log_s: float, received_s: float) -> RetainedStatus:
    said = StatusRecord("laser", measured_ns=int(measured_s * NS))
    return RetainedStatus(said, int(log_s * NS), int(received_s * NS))


def test_ages_are_told_as_one_but_for_those_that_are_older() -> None:
    known = {
        ("laser", ""): standing(99.9, 100, 100.1),
        ("laser", "device"): standing(99.6, 100, 100.1),
        ("imu", ""): standing(90, 100, 100.1),
    }
    found = ages_data(known, ServerNow(int(100.5 * NS), 0))
    assert found == {"age_s": 0.6, "older": [("imu", "", 10.5)]}


def test_ages_go_only_to_those_who_name_them(tmp_path: Path) -> None:
    async def scene() -> None:
        with house(tmp_path / "server") as home:
            async with (
                stage(home) as on, on.browser("viewer") as asks, on.browser("viewer") as all_kinds
            ):  # fmt: skip
                await ask(asks, kinds=["ages"])
                await ask(all_kinds)
                await hear(all_kinds, "snapshot")
                on.status("ropod_001", "ok", measured_ns=home.clock.wall_ns())
                heard = await hear(asks, "ages")
                assert heard["robot"] == "ropod_001"
                assert heard["data"] == {"age_s": 0.0, "older": []}
                with pytest.raises(TimeoutError):
                    async with asyncio.timeout(0.3):
                        await hear(all_kinds, "ages")

    asyncio.run(scene())
