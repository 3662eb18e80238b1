"""Runs that the server cannot go on with: they end, free their robot, and hold up no others."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from amberbox.server.bus import ServerChange
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import MOST_PLANNED, RunOrder, StoredRun
from amberbox.testing.clock import PATIENCE_S
from tests.server.house import House
from tests.support.experiments import DRIVE_FILES

ROBOT = "ropod_001"


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    found = House(tmp_path)
    yield found
    found.close()


def planned(house: House, *, begun: bool = True, repeats: int = 1) -> StoredRun:
    """Return a run of an uploaded experiment."""
    files = {Path(name).name: text.encode() for name, text in DRIVE_FILES.items()}
    drive = house.services.runner.shelf.upload("drive", files, "technician")
    order = RunOrder(
        ROBOT, "experiment", drive.name, drive.title, drive.sha256, {}, "technician",
        repeats=repeats,
    )  # fmt: skip
    with house.services.database.begin() as connection:
        made = runs.add(connection, house.clock.wall_ns(), order)
        if begun:
            house.services.runner.register.begin(connection, made, {}, "technician")
    return found(house, made)


def found(house: House, run: StoredRun) -> StoredRun:
    with house.services.database.reading() as connection:
        stored = runs.find(connection, run.id)
    assert stored is not None
    return stored


def lose(house: House, run: StoredRun) -> None:
    """Take the files of a run away, and let the server forget that it has read them."""
    shelf = house.services.runner.shelf
    shutil.rmtree(shelf.place(run.sha256))
    shelf._read.clear()


def until(house: House, part: str, holds: Callable[[], object]) -> None:
    """Let a background service work until something holds."""

    async def work() -> None:
        house.services.bus.attach(asyncio.get_running_loop())
        task = asyncio.create_task(getattr(house.services, part).run())
        async with asyncio.timeout(PATIENCE_S):
            while not holds():
                assert not task.done(), task.exception()
                await asyncio.sleep(0.05)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(work())


def test_a_run_whose_experiment_is_gone_ends_and_frees_its_robot(house: House) -> None:
    run = planned(house)
    lose(house, run)
    until(house, "runner", lambda: found(house, run).state == "error")
    ended = found(house, run)
    assert "cannot be read any more" in ended.reason and ended.ended_ns is not None
    with house.services.database.reading() as connection:
        assert runs.holder_of(connection, ROBOT) is None


def test_a_run_whose_experiment_is_gone_can_be_aborted(house: House) -> None:
    run = planned(house)
    lose(house, run)
    client = house.client("operator")
    answer = client.post(f"/api/v1/robots/{ROBOT}/runs/{run.id}/abort", json={"reason": "no"})
    assert answer.status_code == 200, answer.text
    assert answer.json()["state"] == "error"
    assert "aborted by operator: no" in answer.json()["reason"]


def test_a_series_that_cannot_go_on_keeps_its_verdict_and_holds_up_no_other_run(
    house: House,
) -> None:
    first, series = (planned(house, begun=False, repeats=repeats) for repeats in (1, 3))
    with house.services.database.begin() as connection:
        for one in (first, series):
            runs.judge(connection, one.id, "judging", "", "")
    for _ in range(MOST_PLANNED):
        planned(house, begun=False)

    def is_judged() -> bool:
        house.clock.advance(3600.0)  # until their records are not awaited any longer
        house.services.bus.publish(ServerChange("committed"))
        return found(house, first).state == "undecided"

    until(house, "judge", is_judged)
    assert found(house, series).state == "undecided"
