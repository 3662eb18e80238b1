"""Contents of folders are cached; a folder that a worker was too slow for is read again."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, cast

import msgspec
import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.ingest.folders import FolderService
from amberbox.server.live.facts import AGAIN_S, FactsCache, FolderFacts
from amberbox.server.workers.pool import WorkerPool
from amberbox.server.workers.protocol import BrokenError, BusyError, too_long
from amberbox.testing.clock import PATIENCE_S

GOOD = msgspec.json.encode(FolderFacts(model="Ropod 2"))


@dataclass
class Desk:
    """A worker that gives prepared answers, and the folders of a robot."""

    answers: list[bytes | AmberboxError]
    now_s: float = 0.0
    asked: int = 0
    book: FactsCache = field(init=False)

    def __post_init__(self) -> None:
        self.book = FactsCache(
            cast("FolderService", self), cast("WorkerPool", self), lambda: self.now_s
        )

    def wants(self, robot: str, config_hash: str) -> bool:
        return config_hash == "unknown"

    def ask_now(self, op: str, arguments: Mapping[str, Any], *limits: float, origin: str) -> bytes:
        self.asked += 1
        answer = self.answers.pop(0)
        if isinstance(answer, AmberboxError):
            raise answer
        return answer

    def read(self) -> FolderFacts:
        return self.book.read("r1", "abab")


def test_a_folder_is_read_once() -> None:
    desk = Desk([GOOD])
    assert desk.book.at_once("r1", "abab") is None
    assert [desk.read().model for _ in range(3)] == ["Ropod 2"] * 3
    assert desk.asked == 1
    assert desk.book.at_once("r1", "abab") == desk.book.known("r1", "abab") == desk.read()


@pytest.mark.parametrize("config_hash", ["", "unknown"])
def test_a_folder_that_is_not_here_is_not_asked_for(config_hash: str) -> None:
    desk = Desk([])
    assert desk.book.read("r1", config_hash).note == "the robot's folder is not here yet"


@pytest.mark.parametrize("error", [too_long(20), BrokenError("the worker ended")])
def test_what_took_too_long_is_tried_again_after_a_while(error: AmberboxError) -> None:
    desk = Desk([error, GOOD])
    assert error.what in desk.read().note
    desk.now_s = AGAIN_S - 1
    assert error.what in desk.read().note
    assert desk.asked == 1
    desk.now_s = AGAIN_S
    assert desk.book.at_once("r1", "abab") is None
    assert desk.read() == FolderFacts(model="Ropod 2")


def test_those_who_ask_at_the_same_time_wait_for_one_answer() -> None:
    desk = Desk([GOOD])
    slow, answer = threading.Event(), desk.ask_now

    def ask_now(*words: Any, **more: Any) -> bytes:
        slow.wait(PATIENCE_S)
        return answer(*words, **more)

    desk.ask_now = ask_now  # type: ignore[method-assign]  # the same, later
    with ThreadPoolExecutor(3) as pool:
        asked = [pool.submit(desk.read) for _ in range(3)]
        slow.set()
        assert [one.result().model for one in asked] == ["Ropod 2"] * 3
    assert desk.asked == 1


def test_a_busy_server_is_asked_again_at_once() -> None:
    desk = Desk([BusyError("too many questions"), GOOD])
    assert "too many questions" in desk.read().note
    assert desk.read().model == "Ropod 2"


def test_a_folder_that_is_wrong_stays_wrong() -> None:
    desk = Desk([UsageError("robot.yaml:3: there is no model")])
    assert "there is no model" in desk.read().note
    desk.now_s = 10 * AGAIN_S
    assert "there is no model" in desk.read().note
    assert desk.asked == 1
