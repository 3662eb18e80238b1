"""Tells browsers and programs what has changed."""

from __future__ import annotations

import asyncio

from amberbox.core.clock import Clock
from amberbox.fleet.bus import Bus
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.server import LinkServer


class Feed:
    """Tells browsers and programs what has changed."""

    def __init__(self, database: Database, bus: Bus, clock: Clock, links: LinkServer) -> None:
        self._links = links
        self._database = database
        self._bus = bus
        self._clock = clock

    async def run(self) -> None:
        """Work until cancelled."""
        await asyncio.Event().wait()

    def close(self) -> None:
        """Let go of what is held."""
