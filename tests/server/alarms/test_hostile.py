"""Invalid reports of robots, and settings that cannot work: alarms continue."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError
from amberbox.link.frames import LinkRow
from amberbox.server.alarms.manager import Alarms
from amberbox.server.alarms.reports import InboxEntry
from amberbox.testing.clock import PATIENCE_S
from tests.server.alarms.stand import Stand, alarm, blocked, stand


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        one.alarms.step()
        yield one


def test_a_component_that_waits_for_very_many_holds_nothing_up(home: Stand) -> None:
    many = (f"component_{n:090}" for n in range(99))
    home.say("r1", alarm(home), blocked(home, "base", "laser", *many))
    assert home.suffering(home.only().number) == {"base": True}
    home.say("r1", alarm(home, "arm"))
    home.hear("r2", alarm(home))
    home.alarms.step()
    assert {(one.robot, one.origin) for one in home.found()} == {
        ("r1", "laser"), ("r1", "arm"), ("r2", "laser"),
    }  # fmt: skip


@pytest.mark.parametrize("outputs", [5, "docked", [5], {"docked": True}, [{"name": "docked"}],
                                     [{"name": "docked", "value": "yes"}]])  # fmt: skip
def test_outputs_that_are_none_excuse_nobody_and_stop_nothing(home: Stand, outputs: object) -> None:
    data = json.dumps({"component": "base", "mode": "m", "outputs": outputs}).encode()
    row = LinkRow("watch", 1, 1, "amberbox/status", home.clock.wall_ns(), data)
    home.send("r1", [row])
    home.lose("r1")
    home.wait(130)
    assert home.only().robot == "r1"


def test_what_cannot_be_taken_is_left_out_and_nothing_else(
    home: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = Alarms._take

    def fails(alarms: Alarms, news: list[InboxEntry]) -> set[int]:
        if any(one.robot == "r1" for one in news):
            raise ZeroDivisionError
        return take(alarms, news)

    monkeypatch.setattr(Alarms, "_take", fails)
    home.hear("r1", alarm(home))
    home.hear("r2", alarm(home))
    home.alarms.step()
    assert home.only().robot == "r2"


def test_news_wait_while_the_database_is_busy(home: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(alarms: Alarms, news: list[InboxEntry]) -> set[int]:
        raise AmberboxError("busy", "later")

    home.hear("r1", alarm(home))
    with monkeypatch.context() as patch, pytest.raises(AmberboxError):
        patch.setattr(Alarms, "_take", busy)
        home.alarms.step()
    home.alarms.step()
    assert home.only().robot == "r1"


def test_a_sender_that_fails_tries_again(home: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []

    def fails() -> int:
        tried.append(time.monotonic())
        raise ZeroDivisionError

    async def scene() -> None:
        monkeypatch.setattr("amberbox.server.alarms.manager._TICK_S", 0.01)
        home.alarms.sender = type("Sender", (), {"step": staticmethod(fails), "close": fails})()
        running = asyncio.create_task(home.alarms._send())
        while len(tried) < 3:
            await asyncio.sleep(0.01)
        running.cancel()

    sender = home.alarms.sender
    asyncio.run(asyncio.wait_for(scene(), PATIENCE_S))
    home.alarms.sender = sender
