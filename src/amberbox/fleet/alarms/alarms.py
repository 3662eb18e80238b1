"""Opens, changes and closes alarms, and tells who has to know."""

from __future__ import annotations

import asyncio

from amberbox.core.clock import Clock
from amberbox.fleet.bus import Bus
from amberbox.fleet.database.database import Database


class Alarms:
    """Opens, changes and closes alarms, and tells who has to know."""

    def __init__(self, database: Database, bus: Bus, clock: Clock) -> None:
        self._database = database
        self._bus = bus
        self._clock = clock

    async def run(self) -> None:
        """Work until cancelled."""
        await asyncio.Event().wait()

    def close(self) -> None:
        """Let go of what is held."""
