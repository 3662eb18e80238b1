"""A robot in a process of its own: writes statuses and events, and links them to a server."""

from __future__ import annotations

import asyncio
import random
import sys
from pathlib import Path

from tests.link.robot.rig import Watcher, client_of


async def live(path: Path, robot: str, port: int, seed: int) -> None:
    """Write until a file beside the store requests silence; stay linked until another requests the
    end.
    """
    chance = random.Random(seed)
    watcher = Watcher(path, robot)
    watcher.count = seed * 1_000_000
    stop = asyncio.Event()
    client = asyncio.create_task(client_of(watcher.store, port, robot).run(stop))
    quiet = path.with_name(path.name + ".quiet")
    while not quiet.exists():
        count, events = chance.randint(1, 4), chance.random() < 0.2
        await asyncio.to_thread(watcher.write, count, int(events), sync=chance.random() < 0.3)
        await asyncio.sleep(0.02)
    await asyncio.to_thread(watcher.close)
    path.with_name(path.name + ".written").touch()
    while not path.with_name(path.name + ".stop").exists():
        await asyncio.sleep(0.05)
    stop.set()
    await client


if __name__ == "__main__":
    asyncio.run(live(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
