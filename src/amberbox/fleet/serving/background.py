"""Runs the parts of the server that work in the background, and starts again what fails."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

from amberbox.core.errors import AmberboxError
from amberbox.fleet.part import Part
from amberbox.link.backoff import Backoff

HEALTHY_S = 60.0
"""A part that ran for so long failed for a new reason: it starts again soon."""


async def keep_running(part: Part, backoff: Backoff | None = None) -> None:
    """Run a part until it ends by itself or is cancelled; after a failure it starts again."""
    waits = backoff or Backoff(least_s=1.0, most_s=60.0)
    loop = asyncio.get_running_loop()
    while True:
        began_s = loop.time()
        try:
            await part.run()
            return
        except AmberboxError as error:  # the database is busy or damaged, the disk is full
            name = type(part).__name__
            logging.getLogger(__name__).error("%s failed and starts again: %s", name, error.what)
        except Exception:  # a defect of one part must not take the server down
            name = type(part).__name__
            logging.getLogger(__name__).exception("%s failed and starts again", name)
        if loop.time() - began_s >= HEALTHY_S:
            waits.succeeded()
        await asyncio.sleep(waits.failed())


def start(parts: Sequence[Part]) -> list[asyncio.Task[None]]:
    """Start all parts."""
    return [asyncio.create_task(keep_running(part), name=type(part).__name__) for part in parts]


async def end(tasks: Sequence[asyncio.Task[None]]) -> None:
    """Cancel all parts and wait for them."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
