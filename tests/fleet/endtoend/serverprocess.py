"""The server's app in a process of its own, over a folder that outlives it."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import uvicorn

from amberbox.fleet.serving import assembly
from amberbox.fleet.serving.app import make_app
from amberbox.fleet.serving.settings import Settings
from amberbox.link import limits


async def serve(folder: Path, port: int) -> None:
    """Serve until it is killed."""
    services = assembly.assemble(folder, Settings(f"http://127.0.0.1:{port}", port=port))
    services.bus.attach(asyncio.get_running_loop())
    working = [asyncio.create_task(part.run()) for part in assembly.parts(services)]
    config = uvicorn.Config(
        make_app(services), "127.0.0.1", port, log_level="error", lifespan="off",
        ws_ping_interval=None, ws_max_size=limits.FRAME_BYTES, ws_per_message_deflate=False,
    )  # fmt: skip
    await uvicorn.Server(config).serve()
    for task in working:
        task.cancel()


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), int(sys.argv[2])))
