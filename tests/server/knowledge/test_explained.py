"""Diagnoses in words: computed by a worker once, before the page is opened."""

import asyncio
import json
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from amberbox.core.errors import UsageError
from amberbox.server.bus import ServerChange
from amberbox.server.knowledge.explanations import Explained, GivenAnswer, keep_answer
from amberbox.testing.clock import PATIENCE_S
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

SILENT = sim.symptom(sim.NO_SCANS, sim.AT_NS)
FOUND = sim.diagnosis(sim.AT_NS, SILENT)


class Worker:
    """Returns given answers, and stores its tasks."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, Any]] = []
        self.fails = False

    async def ask(self, op: str, arguments: Mapping[str, Any], *_: Any, **__: Any) -> bytes:
        self.asked.append(arguments)
        await asyncio.sleep(0)
        if self.fails:
            raise UsageError("the folder is not here")
        return json.dumps({"id": arguments["diagnosis"]}).encode()


@pytest.fixture
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        yield found


@pytest.fixture
def worker(home: House, monkeypatch: pytest.MonkeyPatch) -> Worker:
    found = Worker()
    for workers in (home.services.worker_pool, home.services.robot_worker_pool):
        monkeypatch.setattr(workers, "ask", found.ask)
    return found


async def until_known(explained: Explained, robot: str) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while explained.known(robot, FOUND, {}) is None:
            await asyncio.sleep(0.01)


def test_several_who_want_it_wait_for_the_same_one(home: House, worker: Worker) -> None:
    explained = home.services.explained

    async def all_of() -> list[object]:
        wanted = (explained.read("ropod_001", FOUND, {}, "somebody") for _ in range(5))
        return list(await asyncio.gather(*wanted))

    assert asyncio.run(all_of()) == [{"id": sim.DIAGNOSIS}] * 5
    assert len(worker.asked) == 1
    assert explained.known("ropod_001", FOUND, {}) == {"id": sim.DIAGNOSIS}


def test_nobody_waits_for_one_in_advance(
    home: House, worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    explained, endless = home.services.explained, asyncio.Event()

    async def wait(*_: Any, **__: Any) -> bytes:
        await endless.wait()
        return b"{}"

    async def ask() -> object:
        monkeypatch.setattr(home.services.robot_worker_pool, "ask", wait)
        ahead = asyncio.create_task(explained.read("ropod_001", FOUND, {}, "ropod_001"))
        await asyncio.sleep(0)
        found = await asyncio.wait_for(
            explained.read("ropod_001", FOUND, {}, "somebody"), PATIENCE_S
        )
        ahead.cancel()
        return found

    assert asyncio.run(ask()) == {"id": sim.DIAGNOSIS}


def test_with_another_answer_it_is_another_question(home: House, worker: Worker) -> None:
    explained = home.services.explained
    asyncio.run(explained.read("ropod_001", FOUND, {"laser_front.lamp": "no"}, "somebody"))
    assert explained.known("ropod_001", FOUND, {}) is None
    assert worker.asked[0]["answers"] == {"laser_front.lamp": "no"}


def test_what_failed_is_asked_again(home: House, worker: Worker) -> None:
    explained, worker.fails = home.services.explained, True
    with pytest.raises(UsageError):
        asyncio.run(explained.read("ropod_001", FOUND, {}, "somebody"))
    worker.fails = False
    assert asyncio.run(explained.read("ropod_001", FOUND, {}, "somebody"))


def test_what_stands_is_explained_at_a_start(home: House, worker: Worker) -> None:
    sim.say(home, [(sim.AT_NS, SILENT), (sim.AT_NS, FOUND)])

    async def start() -> None:
        running = asyncio.create_task(home.services.explained.run())
        await until_known(home.services.explained, "ropod_001")
        running.cancel()

    asyncio.run(start())
    assert [about["robot"] for about in worker.asked] == ["ropod_001"]


def test_what_comes_is_explained_before_anybody_asks(home: House, worker: Worker) -> None:
    async def come() -> None:
        running = asyncio.create_task(home.services.explained.run())
        await asyncio.sleep(0.05)
        sim.say(home, [(sim.AT_NS, SILENT), (sim.AT_NS, FOUND)], "ropod_002", 50)
        home.services.bus.publish(ServerChange("diagnosis", "ropod_002", {"id": sim.DIAGNOSIS}))
        await until_known(home.services.explained, "ropod_002")
        running.cancel()

    asyncio.run(come())


def test_what_an_answer_gave_is_told_and_not_asked_again(home: House, worker: Worker) -> None:
    sim.say(home, [(sim.AT_NS, SILENT), (sim.AT_NS, FOUND)])
    given = GivenAnswer("laser_front.lamp", "no", "anna", sim.AT_NS)
    body = {"id": FOUND.id, "revision": FOUND.revision, "state": "open"}
    with home.services.database.begin() as connection:
        keep_answer(connection, "ropod_001", FOUND.id, given, json.dumps(body).encode())
    told: list[Any] = []
    home.services.bus.on("explained", lambda change: told.append(change.data["answer"]))

    async def start() -> None:
        running = asyncio.create_task(home.services.explained.run())
        async with asyncio.timeout(PATIENCE_S):
            while not told:
                await asyncio.sleep(0.01)
        running.cancel()

    asyncio.run(start())
    assert (told, worker.asked) == ([body], [])


def test_one_that_cannot_be_explained_keeps_no_other_one_waiting(
    home: House, worker: Worker
) -> None:
    sim.say(home, [(sim.AT_NS, SILENT), (sim.AT_NS, FOUND)])
    worker.fails = True

    async def go_on() -> None:
        running = asyncio.create_task(home.services.explained.run())
        while not worker.asked:
            await asyncio.sleep(0.01)
        worker.fails = False
        home.services.bus.publish(ServerChange("robot", "ropod_001"))
        await until_known(home.services.explained, "ropod_001")
        running.cancel()

    asyncio.run(asyncio.wait_for(go_on(), PATIENCE_S))
