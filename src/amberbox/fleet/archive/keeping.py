"""Keeps the archive going: commits what came, joins, sweeps and deletes, and watches the disk.

The work is done by the archive's worker; one that dies is started again and finishes what was
begun. Nothing of it holds up robots or people.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.archive import settling
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.forgetting import forget
from amberbox.fleet.archive.room import Room, Usage, room_of
from amberbox.fleet.archive.store import Retention
from amberbox.fleet.archive.worker import Worker, WorkFailedError
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.linkend.events import note
from amberbox.fleet.options import options
from amberbox.fleet.uploads.pieces import Incoming
from amberbox.link.backoff import Backoff
from amberbox.link.frames import Hello
from amberbox.link.uploads import Proof

T = TypeVar("T")

_RETAINED = "archive.retained"
_DAY_NS = 24 * 3600 * NS - 60 * NS
"""A day, and a minute less: what is looked at every hour never comes at the second."""

RETENTION = "retention"
"""Name of the setting: a list of rules; without any everything is kept."""
COMMIT_S = 60.0
_GATHER_S = 1.0
"""So long a first journal waits for others: robots come home together."""
_HOUR_S = 3600.0
_FIRST_S = 600.0
"""When a server that was just started first tidies up."""
_DISK_S = 10.0


@dataclass(frozen=True, slots=True)
class Retained:
    """When data that are too old were deleted last."""

    at_ns: int = 0


class Keeping:
    """Has journals committed as they come, and the archive tidied; a part of the server."""

    def __init__(
        self, folder: Path, database: Database, bus: Bus, clock: Clock, archive: FolderArchive,
        *, every_s: float = COMMIT_S, usage: Usage = shutil.disk_usage,
    ) -> None:  # fmt: skip
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._archive = archive
        self._ages = archive.ages
        self._every_s = every_s
        self._usage = usage
        self._worker = Worker(folder)
        self._thread = ThreadPoolExecutor(1, "archive")  # one request at a time
        self._woken = asyncio.Event()
        self._room = room_of(folder, usage)
        self._said = "disk_ok"
        self._trouble = ""
        bus.on("journal", self._hear)
        bus.on("robot", self._hear)  # its signing key may have been confirmed
        bus.on("connected", self._hear_connected)
        bus.on("gone", lambda change: self._ages.forget(change.robot))

    @property
    def is_full(self) -> bool:
        """Tell whether the disk has no room for what robots send."""
        return self._room.is_full

    @property
    def room(self) -> Room:
        """What was free on the disk when it was looked at last."""
        return self._room

    def troubles(self) -> list[str]:
        """Say what is wrong with the archive and its disk; nothing when all is well."""
        low = f"the disk is nearly full: {self._room}" if self._room.is_low else ""
        return [text for text in (low, self._trouble, self._ages.read().text) if text]

    def note_deleted(self, incoming: Incoming, proof: Proof) -> None:
        """Tell the archive what the robot says it deleted before it could be copied."""
        missing = list(settling.deleted(proof))
        if missing:
            self._archive.note_missing(incoming.robot, incoming.store_id, missing)

    async def run(self) -> None:
        """Work until cancelled."""
        await self._look_at_disk()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._commit_always())
            group.create_task(self._tidy_always())
            group.create_task(self._watch_disk())

    def close(self) -> None:
        """End the worker; what it had begun it finishes after the next start."""
        self._worker.stop()
        self._thread.shutdown(cancel_futures=True)

    def _hear(self, _: Change) -> None:
        self._woken.set()

    def _hear_connected(self, change: Change) -> None:
        hello = change.data.get("hello")
        if isinstance(hello, Hello):
            self._ages.hear(change.robot, hello.wall_ns)
        if getattr(change.data.get("admission"), "aside", ()):
            self._woken.set()

    async def _apart(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    async def _commit_always(self) -> None:
        backoff = Backoff(least_s=1.0, most_s=60.0)
        await self._apart(partial(settling.take_over, self._archive, self._database, self._folder))
        await self._apart(self._archive.try_again)
        while True:
            self._woken.clear()
            try:
                wait_s = await self._commit_once()
            except WorkFailedError as error:
                await self._apart(partial(self._archive.note_failure, error.journal, error.what))
                self._failed(error)
                wait_s = backoff.failed()
            except AmberboxError as error:
                self._failed(error)
                wait_s = backoff.failed()
            else:
                self._trouble = ""
                backoff.succeeded()
            await self._wait(wait_s)

    async def _commit_once(self) -> float | None:
        """Commit what is due; return after how many seconds more is, None if nothing waits."""
        archive, database = self._archive, self._database
        await self._apart(partial(settling.take_confirmed, archive, database, self._folder))
        await self._apart(partial(settling.note_lost, archive, database))
        self._tell(await self._apart(partial(settling.settle, self._database, self._clock)))
        if not await self._apart(self._has_work):
            return None
        done = await self._apart(partial(self._worker.commit, self._every_s))
        self._tell(await self._apart(partial(settling.settle, self._database, self._clock)))
        return done.next_in_s if done.waiting else None

    def _has_work(self) -> bool:
        """Look before the worker is woken: where nothing waits, none is started."""
        catalogue = self._archive.catalogue
        return catalogue.open_batch() is not None or bool(catalogue.waiting())

    def _tell(self, robots: list[str]) -> None:
        if robots:
            self._bus.publish(Change("committed", data={"robots": robots}))

    async def _wait(self, wait_s: float | None) -> None:
        if wait_s is not None:
            await asyncio.sleep(max(wait_s, 0.05))
            return
        await self._woken.wait()
        await asyncio.sleep(min(_GATHER_S, self._every_s))

    async def _tidy_always(self) -> None:
        """Join and sweep every hour, delete what is too old once a day."""
        await asyncio.sleep(_FIRST_S)
        while True:
            try:
                await self._apart(self._tidy_once)
            except AmberboxError as error:
                self._failed(error)
            await asyncio.sleep(_HOUR_S)

    def _tidy_once(self) -> None:
        """Tidy; when old data were deleted last is kept, for servers that are restarted daily."""
        now_ns = self._clock.wall_ns()
        with self._database.reading() as connection:
            since_ns = now_ns - options.read(connection, _RETAINED, Retained).at_ns
        is_daily = not 0 <= since_ns < _DAY_NS
        self.tidy(is_daily=is_daily)
        if is_daily:
            with self._database.begin() as connection:
                options.write(connection, now_ns, _RETAINED, Retained(now_ns))

    def tidy(self, *, is_daily: bool) -> None:
        """Tidy the archive once; blocks. Raises AmberboxError when the worker could not."""
        with self._database.reading() as connection:
            rules = options.read(connection, RETENTION, tuple[Retention, ...])
        now_ns = self._ages.look().age_ns
        if is_daily:
            forget(self._database, rules, now_ns)
        if not self._archive.catalogue.revision():
            return
        if is_daily:
            self._worker.retain(now_ns, *rules)
        self._worker.compact()
        self._worker.sweep()

    def _failed(self, error: AmberboxError) -> None:
        journal = getattr(error, "journal", "")
        what = error.what.removeprefix("the archive: ")
        self._trouble = f"the archive: {what}" + (f" (journal {journal})" if journal else "")
        logging.getLogger(__name__).warning("%s (%s)", self._trouble, error.hint)

    async def _watch_disk(self) -> None:
        while True:
            await asyncio.sleep(_DISK_S)
            await self._look_at_disk()

    async def _look_at_disk(self) -> None:
        """Look at the disk; when its state changes an event says so."""
        self._room = await asyncio.to_thread(room_of, self._folder, self._usage)
        await asyncio.to_thread(self._look_at_clock)
        state = _state(self._room)
        if state != self._said:
            self._said = state
            await asyncio.to_thread(self._note_disk, state)

    def _look_at_clock(self) -> None:
        with suppress(AmberboxError):  # the database is busy: the next look does as well
            self._ages.look()

    def _note_disk(self, state: str) -> None:
        text = _TEXTS[state].format(self._room)
        with self._database.begin() as connection:
            note(connection, "", self._clock.wall_ns(), state, text)


_TEXTS = {
    "disk_ok": "the server's disk has room again: {}",
    "disk_low": "the server's disk is nearly full: {}",
    "disk_full": "the server's disk is full, journals stay on the robots: {}",
}


def _state(room: Room) -> str:
    return "disk_full" if room.is_full else "disk_low" if room.is_low else "disk_ok"
