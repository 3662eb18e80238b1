"""A server of the link in a process of its own."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from amberbox.fleet.database.database import Database
from tests.robot.link.rig import serving


async def serve_forever(path: Path, port: int) -> None:
    """Serve until it is killed."""
    async with serving(Database(path), port=port):
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve_forever(Path(sys.argv[1]), int(sys.argv[2])))
