"""Threads for what blocks for long: journals that come in must not hold up who looks at robots."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


class Threads:
    """Two sets of threads: for pieces of journals, and for their ends.

    Ends wait for the one worker that verifies; pieces of others go on meanwhile.
    """

    def __init__(self) -> None:
        self._pieces = ThreadPoolExecutor(8, "pieces")
        self._ends = ThreadPoolExecutor(16, "ends")

    async def piece(self, work: Callable[[], T]) -> T:
        """Do something that is over soon."""
        return await asyncio.get_running_loop().run_in_executor(self._pieces, work)

    async def end(self, work: Callable[[], T]) -> T:
        """Do something that waits for a verification."""
        return await asyncio.get_running_loop().run_in_executor(self._ends, work)

    def close(self) -> None:
        """Finish what was begun, and do nothing of what waits."""
        for threads in (self._pieces, self._ends):
            threads.shutdown(wait=False, cancel_futures=True)
