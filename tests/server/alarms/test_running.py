"""The alarms of a server that runs: in an event loop, with threads, until it is stopped."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

from amberbox.testing.clock import PATIENCE_S
from tests.server.alarms.stand import Stand, alarm, stand


def test_it_listens_acts_and_stops(tmp_path: Path) -> None:
    with stand(tmp_path) as home:
        asyncio.run(_run(home))
        assert [message.subject for _, message in home.told] == ["urgent: r1 laser"]
        assert home.published


async def _run(home: Stand) -> None:
    home.bus.attach(asyncio.get_running_loop())
    running = asyncio.create_task(home.alarms.run())
    await asyncio.to_thread(home.hear, "r1", alarm(home))
    deadline = time.monotonic() + PATIENCE_S
    while not home.told and time.monotonic() < deadline:
        if home.published:
            home.clock.advance(5)
        await asyncio.sleep(0.05)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert running.cancelled()
