"""Long jobs of people: queued in the database, run one at a time by a worker process of low
priority, and run again when the server ended meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeAlias, TypeVar

from sqlalchemy import Connection

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.workers.pool import WorkerPool
from amberbox.server.workers.protocol import WorkerTask

OpenState: TypeAlias = Literal["queued", "running"]
OPEN: Sequence[OpenState] = ("queued", "running")

_LOOK_S = 60.0
_REPORT_S = 1.0
_NICE = 10


class QueuedJob(Protocol):
    """A row of a table of jobs."""

    @property
    def id(self) -> str:
        """Return the id, which is also the name of the job's folder."""

    @property
    def owner(self) -> str:
        """Return the person who asked for it."""


Job = TypeVar("Job", bound=QueuedJob)
Answer = TypeVar("Answer")


class JobService(ABC, Generic[Job]):
    """Runs the queued jobs of one table; interrupted ones are run again."""

    def __init__(self, folder: Path, database: ServerDatabase, bus: EventBus, clock: Clock) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._pool = WorkerPool(folder, 1, nice=_NICE)
        self._wake = asyncio.Event()
        self._now: tuple[str, WorkerTask] | None = None
        bus.on("job", lambda change: self._wake.set())

    @abstractmethod
    def begin_again(self, connection: Connection) -> None:
        """Queue the jobs again that were running when the server ended."""

    @abstractmethod
    def next_one(self, connection: Connection) -> Job | None:
        """Return the job to run next."""

    @abstractmethod
    def change(
        self, connection: Connection, job_id: str, only: Sequence[OpenState], values: Any
    ) -> bool:
        """Change a job that is in one of the states ``only``; return whether it was."""

    @abstractmethod
    def task(self, job: Job, receive: Callable[[bytes], None]) -> WorkerTask:
        """Return the task of a job; ``receive`` takes what the worker reports."""

    @abstractmethod
    def progress(self, part: bytes) -> tuple[float, Mapping[str, Any]]:
        """Return how far a report is (0 to 1), and the values of the row when it is the last."""

    @abstractmethod
    def tidy(self) -> None:
        """Delete what is not kept any more."""

    def cancel(self, job: Job) -> None:
        """Stop a job that was cancelled; thread-safe."""
        now = self._now
        if now is not None and now[0] == job.id:
            now[1].cancel()

    def is_running(self, job_id: str) -> bool:
        """Return whether a worker runs a job now."""
        return self._now is not None and self._now[0] == job_id

    async def run(self) -> None:
        """Work until cancelled."""
        self._wake = asyncio.Event()  # belongs to this event loop
        await asyncio.to_thread(self._write, self.begin_again)
        await asyncio.to_thread(self.tidy)
        while True:
            job = await asyncio.to_thread(self._read, self.next_one)
            if job is not None:
                await self._run(job)
                await asyncio.to_thread(self.tidy)
                continue
            with suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_S):  # wait_for may swallow a cancellation
                    await self._wake.wait()
            self._wake.clear()
            await asyncio.to_thread(self.tidy)

    def close(self) -> None:
        """Stop the worker; an interrupted job is run again after the next start."""
        self._pool.close()

    def _read(self, read_from: Callable[[Connection], Answer]) -> Answer:
        with self._database.reading() as connection:
            return read_from(connection)

    def _write(self, work: Callable[[Connection], Answer]) -> Answer:
        with self._database.begin() as connection:
            return work(connection)

    async def _change(self, job: Job, only: OpenState, **values: Any) -> bool:
        changed = await asyncio.to_thread(
            self._write, lambda connection: self.change(connection, job.id, [only], values)
        )
        self._publish(job)
        return changed

    def _publish(self, job: Job) -> None:
        self._bus.publish(ServerChange("job", "", {"id": job.id, "owner": job.owner}))

    async def _run(self, job: Job) -> None:
        now_ns = self._clock.wall_ns()
        if not await self._change(job, "queued", state="running", progress=0.0, started_ns=now_ns):
            return  # was cancelled meanwhile
        last, reported_s = b"", 0.0

        def receive(part: bytes) -> None:
            """Receive the worker's report, in the pool's thread; publish it at most once a
            second.
            """
            nonlocal last, reported_s
            last = part
            if time.monotonic() - reported_s < _REPORT_S:
                return
            reported_s = time.monotonic()
            share, _ = self.progress(part)
            with self._database.begin() as connection:
                self.change(connection, job.id, ["running"], {"progress": share})
            self._publish(job)

        task = await asyncio.to_thread(self.task, job, receive)
        self._now = job.id, task
        try:
            self._pool.submit(task)
            await asyncio.wrap_future(task.done)
        except asyncio.CancelledError:
            task.cancel()
            raise
        except Exception as error:  # only this job fails
            text = error.what if isinstance(error, AmberboxError) else type(error).__name__
            logging.getLogger(__name__).warning("%s failed", job.id, exc_info=error)
            await self._ended(job, "failed", error=text)
        else:
            _, made = self.progress(last)
            await self._ended(job, "done", progress=1.0, **made)
        finally:
            self._now = None

    async def _ended(self, job: Job, state: str, **values: Any) -> None:
        ended_ns = self._clock.wall_ns()
        await self._change(job, "running", state=state, ended_ns=ended_ns, **values)
