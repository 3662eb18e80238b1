"""How long a test waits for an event before it gives up: one limit, for the slowest machine."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

PATIENCE_S = 60.0
"""Limit in seconds of every wait for an event; a test that passes ends its wait long before."""

_LOOK_S = 0.01


def wait_until(condition: Callable[[], object], what: str = "what is waited for") -> None:
    """Wait until a condition holds; raise TimeoutError naming it after ``PATIENCE_S``."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}")
        time.sleep(_LOOK_S)


async def until(condition: Callable[[], object], what: str = "what is waited for") -> None:
    """Wait in an event loop until a condition holds; raise TimeoutError as ``wait_until``."""
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(f"not within {PATIENCE_S:g} s: {what}")
        await asyncio.sleep(_LOOK_S)
