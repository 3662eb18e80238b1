"""Makes extracts in the background: one at a time, in a worker, one file each."""

from __future__ import annotations

import asyncio
import logging
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from sqlalchemy import Connection

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.fleet.asking.pool import Pool
from amberbox.fleet.asking.question import Question
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.jobs import ledger
from amberbox.fleet.jobs.ledger import Job
from amberbox.fleet.jobs.wanted import FOLDER, Downloads
from amberbox.fleet.options.options import read

SETTING = "downloads"
OP = "amberbox.fleet.jobs.worker:make"

_LOOK_S = 60.0
_TELL_S = 1.0
_NICE = 10
_MEMORY_BYTES = 2 << 30

Answer = TypeVar("Answer")


class Made(msgspec.Struct, frozen=True):
    """What a worker says of a download that it makes."""

    progress: float
    file: str = ""
    bytes: int = 0
    notes: list[str] = []


class Jobs:
    """Makes the downloads that are queued in the database; what was begun is begun again."""

    def __init__(self, folder: Path, database: Database, bus: Bus, clock: Clock) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._pool = Pool(folder, 1, nice=_NICE)
        self._asked = asyncio.Event()
        self._now: tuple[str, Question] | None = None
        bus.on("job", self._hear)

    def path(self, job: Job) -> Path:
        """Return where the file of a download lies."""
        return self._folder / FOLDER / job.id / job.file

    def cancel(self, job: Job) -> None:
        """Stop making a download whose state says so; thread-safe."""
        now = self._now
        if now is not None and now[0] == job.id:
            now[1].cancel()

    async def run(self) -> None:
        """Work until cancelled."""
        self._asked = asyncio.Event()  # of this event loop
        await self._do(ledger.begin_again)
        await asyncio.to_thread(self._tidy)
        while True:
            job = await asyncio.to_thread(self._next)
            if job is not None:
                await self._make(job)
                await asyncio.to_thread(self._tidy)
                continue
            with suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_S):  # wait_for may swallow the end of the server
                    await self._asked.wait()
            self._asked.clear()
            await asyncio.to_thread(self._tidy)

    def close(self) -> None:
        """Stop the worker; what it was at is begun again with the next start."""
        self._pool.close()

    def _hear(self, change: Change) -> None:
        self._asked.set()

    def _next(self) -> Job | None:
        with self._database.reading() as connection:
            return ledger.next_one(connection)

    def _options(self) -> Downloads:
        with self._database.reading() as connection:
            return read(connection, SETTING, Downloads)

    async def _do(self, work: Callable[[Connection], Answer]) -> Answer:
        def in_transaction() -> Answer:
            with self._database.begin() as connection:
                return work(connection)

        return await asyncio.to_thread(in_transaction)

    async def _change(self, job: Job, only: ledger.State, **values: Any) -> bool:
        changed = await self._do(
            lambda connection: ledger.change(connection, job.id, only=[only], **values)
        )
        self._bus.publish(Change("job", "", {"id": job.id, "owner": job.owner}))
        return changed

    async def _make(self, job: Job) -> None:
        now_ns = self._clock.wall_ns()
        if not await self._change(job, "queued", state="running", progress=0.0, started_ns=now_ns):
            return  # cancelled meanwhile
        options = await asyncio.to_thread(self._options)
        hearing = _Hearing(self._database, self._bus, job)
        arguments = {
            "id": job.id, "wanted": msgspec.to_builtins(job.wanted), "asked_ns": job.asked_ns,
            "most_bytes": int(options.each_gb * 1e9),
        }  # fmt: skip
        question = Question(OP, arguments, hearing.hear, options.limit_h * 3600, _MEMORY_BYTES)
        self._now = job.id, question
        try:
            self._pool.put(question)
            await asyncio.wrap_future(question.done)
        except asyncio.CancelledError:
            question.cancel()
            raise
        except Exception as error:  # of this one: the next ones are made
            text = error.what if isinstance(error, AmberboxError) else type(error).__name__
            logging.getLogger(__name__).warning("%s failed", job.id, exc_info=error)
            await self._ended(job, "failed", error=text)
        else:
            made = hearing.last
            await self._ended(
                job, "done", progress=1.0, file=made.file, bytes=made.bytes,
                notes=msgspec.json.encode(made.notes).decode(),
            )  # fmt: skip
        finally:
            self._now = None

    async def _ended(self, job: Job, state: ledger.State, **values: Any) -> None:
        ended_ns = self._clock.wall_ns()
        await self._change(job, "running", state=state, ended_ns=ended_ns, **values)

    def _tidy(self) -> None:
        """Remove the files of downloads that are too old, too much, or were never finished."""
        now_ns = self._clock.wall_ns()
        with self._database.begin() as connection:
            options = read(connection, SETTING, Downloads)
            for job in ledger.outdated(connection, now_ns, options):
                ledger.change(connection, job.id, only=["done"], state="expired")
            ledger.forget(connection, now_ns)
            kept = {job.id for job in ledger.listed(connection, None, limit=10_000)
                    if job.state == "done"}  # fmt: skip
        folder = self._folder / FOLDER
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name not in kept and (self._now is None or path.name != self._now[0]):
                shutil.rmtree(path, ignore_errors=True)


@dataclass
class _Hearing:
    """Takes what the worker says, in the pool's thread, and passes it on once a second."""

    database: Database
    bus: Bus
    job: Job
    last: Made = field(default_factory=lambda: Made(0.0))
    told_s: float = 0.0

    def hear(self, part: bytes) -> None:
        """Take one message of the worker."""
        self.last = msgspec.json.decode(part, type=Made)
        if time.monotonic() - self.told_s < _TELL_S:
            return
        self.told_s = time.monotonic()
        with self.database.begin() as connection:
            ledger.change(connection, self.job.id, only=["running"], progress=self.last.progress)
        self.bus.publish(Change("job", "", {"id": self.job.id, "owner": self.job.owner}))
