"""Threads for what blocks for long: journals that come in must not hold up who looks at robots."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from amberbox.fleet.asking.errors import BusyError

T = TypeVar("T")

EACH = 8
"""Bodies of one robot that are taken in at a time: their memory has an end, whatever it sends."""


class Threads:
    """Sets of threads: for pieces of journals, for their ends, for folders.

    Ends wait for the one worker that verifies, folders for those that unpack; pieces of others go
    on meanwhile, and so does all that is done in the loop's own threads.
    """

    def __init__(self) -> None:
        self._pieces = ThreadPoolExecutor(8, "pieces")
        self._ends = ThreadPoolExecutor(16, "ends")
        self._folders = ThreadPoolExecutor(2 * EACH, "folders")
        self._under_way: Counter[str] = Counter()

    async def piece(self, work: Callable[[], T]) -> T:
        """Do something that is over soon."""
        return await asyncio.get_running_loop().run_in_executor(self._pieces, work)

    async def end(self, work: Callable[[], T]) -> T:
        """Do something that waits for a verification."""
        return await asyncio.get_running_loop().run_in_executor(self._ends, work)

    async def folder(self, work: Callable[[], T]) -> T:
        """Do something that waits until a folder is unpacked."""
        return await asyncio.get_running_loop().run_in_executor(self._folders, work)

    @contextmanager
    def turn(self, robot: str) -> Iterator[None]:
        """Count a request that takes in a body; raises BusyError when a robot has too many.

        In the event loop only.
        """
        if self._under_way[robot] >= EACH:
            raise BusyError(f"{EACH} requests of {robot} are under way already", "one by one")
        self._under_way[robot] += 1
        try:
            yield
        finally:
            self._under_way[robot] -= 1
            self._under_way += Counter()  # forgets those of which there are none

    def close(self) -> None:
        """Finish what was begun, and do nothing of what waits."""
        for threads in (self._pieces, self._ends, self._folders):
            threads.shutdown(wait=False, cancel_futures=True)
