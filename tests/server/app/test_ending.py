"""The end of the server's process: soon, even with open requests."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from pathlib import Path

import pytest

from amberbox.server import process
from amberbox.server.config import ServerSettings
from amberbox.server.database import DatabaseDamagedError
from amberbox.server.workers.pool import WorkerPool
from amberbox.testing.clock import PATIENCE_S
from tests.server.house import house
from tests.server.workers.program import MODULE

PROGRAM = "tests.server.workers.program"
LASTS_S = 2 * PATIENCE_S


def test_a_question_that_takes_long_holds_up_no_end(tmp_path: Path) -> None:
    with house(tmp_path / "server") as home:
        worker_pool, told = WorkerPool(tmp_path, 1, program=PROGRAM), list[BaseException]()
        home.services.worker_pool = worker_pool

        def ask() -> None:
            try:
                worker_pool.ask_now(f"{MODULE}:echo", {"text": "", "wait_s": LASTS_S}, LASTS_S + 5)
            except Exception as error:
                told.append(error)

        async def scene() -> None:
            loop = asyncio.get_running_loop()
            port = process.listen(ServerSettings("http://localhost", port=0))
            loop.run_in_executor(None, ask)
            loop.call_later(2.0, os.kill, os.getpid(), signal.SIGTERM)
            await process.serve(home.services, port)

        began_s = time.monotonic()
        asyncio.run(scene())
        assert time.monotonic() - began_s < PATIENCE_S
        assert len(told) == 1, "it was told that nobody answers any more"


def test_damage_of_the_database_ends_the_server_in_order(tmp_path: Path) -> None:
    with house(tmp_path / "server") as home:
        answers = list[int]()

        async def scene() -> None:
            port = process.listen(ServerSettings("http://localhost", port=0))

            def ready(_: int) -> None:
                home.services.database.damage = DatabaseDamagedError(tmp_path, "malformed")
                answers.append(1)

            await process.serve(home.services, port, process.LifecycleHooks(ready=ready))

        with pytest.raises(DatabaseDamagedError, match="is damaged: malformed"):
            asyncio.run(scene())
        assert answers == [1]
