"""Parts of the server that fail start again; the others do not notice."""

from __future__ import annotations

import asyncio
import logging
import random

import pytest

from amberbox.core.pacing import Backoff
from amberbox.server import process
from amberbox.testing.clock import PATIENCE_S


class Failing:
    """Fails a few times, then works."""

    def __init__(self, failures: int) -> None:
        self.failures, self.starts = failures, 0
        self.works = asyncio.Event()

    async def run(self) -> None:
        self.starts += 1
        if self.starts <= self.failures:
            raise RuntimeError("a defect")
        self.works.set()
        await asyncio.Event().wait()

    def close(self) -> None:
        """Nothing is held."""


def test_a_part_that_fails_is_started_again_and_the_failure_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def scene() -> int:
        part = Failing(3)
        waits = Backoff(random.Random(1), 0.001, 0.01)
        task = asyncio.create_task(process.keep_running(part, waits))
        await asyncio.wait_for(part.works.wait(), PATIENCE_S)
        await process.end([task])
        assert task.cancelled()
        return part.starts

    with caplog.at_level(logging.ERROR):
        assert asyncio.run(scene()) == 4
    assert [record.getMessage() for record in caplog.records] == [
        "Failing failed and starts again"
    ] * 3


def test_parts_do_not_hold_each_other_up() -> None:
    async def scene() -> None:
        parts = [Failing(1000), Failing(0)]
        tasks = process.start(parts)
        await asyncio.wait_for(parts[1].works.wait(), PATIENCE_S)
        await process.end(tasks)

    asyncio.run(scene())
