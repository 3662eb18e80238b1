"""A part that is cancelled ends, also when what it waits for comes at the same moment."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.clock import SystemClock
from amberbox.link.frames import BeatFrame
from amberbox.server.bus import EventBus
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_server import LinkServer, SessionRevocation
from amberbox.server.live.feed import Feed
from tests.server.house import house
from tests.support.sockets import FakeSocket

TURNS = range(6)
"""How many turns of the event loop lie between what comes and the end."""


async def _ends(work: Coroutine[Any, Any, None], happen: Callable[[], object], turns: int) -> bool:
    """Let something happen, cancel soon after; tell whether the work ends."""
    task = asyncio.create_task(work)
    await asyncio.sleep(0.05)
    happen()
    for _ in range(turns):
        await asyncio.sleep(0)
    task.cancel()
    done, _ = await asyncio.wait({task}, timeout=0.5)
    task.cancel()
    await asyncio.wait({task}, timeout=0.5)
    return bool(done)


@pytest.mark.parametrize("turns", TURNS)
def test_the_doorkeeper_ends(tmp_path: Path, turns: int) -> None:
    database = ServerDatabase(tmp_path / "server.db")
    links = LinkServer(database)
    revocation = SessionRevocation(database, EventBus(), SystemClock(), links)
    assert asyncio.run(_ends(revocation.run(), revocation._changed.set, turns))
    links.close()
    database.close()


def test_the_checks_of_the_feed_end(tmp_path: Path) -> None:
    with house(tmp_path) as one:
        feed: Feed = one.services.feed
        for turns in TURNS:
            assert asyncio.run(_ends(feed._checks(), feed._check.set, turns)), turns


@pytest.mark.parametrize("turns", TURNS)
def test_a_link_ends(tmp_path: Path, turns: int) -> None:
    database = ServerDatabase(tmp_path / "server.db")
    links = LinkServer(database)

    async def run() -> bool:
        socket = FakeSocket()
        return await _ends(links.serve(socket, "r1"), lambda: socket.say(BeatFrame(1, 0, 0)), turns)

    assert asyncio.run(run())
    links.close()
    database.close()
