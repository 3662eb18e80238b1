"""Stop working for whoever has closed the connection."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from starlette.requests import Request

from amberbox.fleet.asking.errors import CancelledError

_LOOK_S = 0.25

Answer = TypeVar("Answer")


async def while_there(request: Request, work: Coroutine[Any, Any, Answer]) -> Answer:
    """Do some work as long as the client of a request is there.

    Raises CancelledError, which nobody will read, when it has gone: the work is cancelled.
    """
    task = asyncio.ensure_future(work)
    try:
        while not (await asyncio.wait({task}, timeout=_LOOK_S))[0]:
            if await request.is_disconnected():
                raise CancelledError("nobody waits for this answer any more")
        return task.result()
    finally:
        task.cancel()
