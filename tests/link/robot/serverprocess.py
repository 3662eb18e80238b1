"""A server of the link in a process of its own."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from amberbox.server.database import ServerDatabase
from tests.link.robot.rig import serving


async def serve_forever(path: Path, port: int) -> None:
    """Serve until it is killed."""
    async with serving(ServerDatabase(path), port=port):
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve_forever(Path(sys.argv[1]), int(sys.argv[2])))
