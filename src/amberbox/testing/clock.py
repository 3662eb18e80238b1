"""Time in tests: a clock moved by hand, and waits for events with one limit for all."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from amberbox.core.clock import NS


@dataclass
class ManualClock:
    """A clock that advances only by ``advance`` or ``step``."""

    wall: int = 1_700_000_000 * NS
    boot: int = 100 * NS
    boot_name: str = "00000000-0000-4000-8000-000000000000"
    is_synchronised: bool | None = True

    def wall_ns(self) -> int:
        return self.wall

    def boot_ns(self) -> int:
        return self.boot

    def boot_id(self) -> str:
        return self.boot_name

    def synchronised(self) -> bool | None:
        return self.is_synchronised

    def advance(self, seconds: float) -> None:
        """Advance both clocks by some seconds."""
        self.wall += round(seconds * NS)
        self.boot += round(seconds * NS)

    def step(self, seconds: float) -> None:
        """Set the wall clock forward (or back) as NTP or a person would."""
        self.wall += round(seconds * NS)


PATIENCE_S = 60.0  # limit of every wait for an event; a passing test waits far less

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
