"""Watches teams and the system on the server."""

from __future__ import annotations

import asyncio
from pathlib import Path

from amberbox.core.clock import Clock
from amberbox.fleet.bus import Bus
from amberbox.fleet.database.database import Database


class SystemLevel:
    """Watches teams and the system on the server."""

    def __init__(self, folder: Path, database: Database, bus: Bus, clock: Clock) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock

    async def run(self) -> None:
        """Work until cancelled."""
        await asyncio.Event().wait()

    def close(self) -> None:
        """Let go of what is held."""
