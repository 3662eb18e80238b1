"""Downloads: requested by people, made one at a time by a worker process, deleted after a while."""

from __future__ import annotations

import math
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.api import DownloadFormat, DownloadState
from amberbox.core.errors import UsageError
from amberbox.server.schema import JOB
from amberbox.server.settings import read
from amberbox.server.workers.jobs import OPEN as OPEN
from amberbox.server.workers.jobs import JobService, OpenState
from amberbox.server.workers.protocol import WorkerTask

FOLDER = "downloads"
"""Below the server's data folder: one folder per download."""


class DownloadRequest(msgspec.Struct, frozen=True):
    """Items of robots (all without a name), in missions or in ``[from_ns, to_ns)``.

    ``variables`` names columns per item, for csv and parquet. ``missions`` are ids, or ``last:3``,
    ``failed:3``, ``transport:3``: of each robot.
    """

    robots: list[str]
    format: DownloadFormat
    items: list[str] = []
    variables: dict[str, list[str]] = {}
    missions: list[str] = []
    from_ns: int | None = None
    to_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Downloads:
    """How long finished downloads are kept, how much room they have, how many one may ask for."""

    kept_h: float = 24.0
    quota_gb: float = 20.0
    each_gb: float = 5.0
    each_waiting: int = 20
    limit_h: float = 2.0

    def __post_init__(self) -> None:
        """Raise ValueError for numbers out of range."""
        for name in ("kept_h", "quota_gb", "each_gb", "limit_h"):
            if not (math.isfinite(getattr(self, name)) and 0 < getattr(self, name) <= 1e6):
                raise ValueError(f"{name} is above 0, and 1000000 at most")
        if not 1 <= self.each_waiting <= 1000:
            raise ValueError("each_waiting is 1 to 1000")


_REMEMBERED_NS = 30 * 24 * 3600 * 10**9


@dataclass(frozen=True, slots=True)
class DownloadJob:
    """A download: its owner, its request, and its state."""

    id: str
    owner: str
    wanted: DownloadRequest
    state: DownloadState
    progress: float
    file: str
    bytes: int
    notes: list[str]
    error: str
    asked_ns: int
    started_ns: int | None
    ended_ns: int | None


def add(
    connection: Connection, now_ns: int, owner: str, wanted: DownloadRequest, options: Downloads
) -> DownloadJob:
    """Queue a download; raises UsageError when the owner has too many."""
    mine = select(func.count()).select_from(JOB)
    count = connection.scalar(mine.where(JOB.c.owner == owner, JOB.c.state.in_(OPEN))) or 0
    if count >= options.each_waiting:
        raise UsageError(f"{count} of your downloads are being made", "wait for one, or cancel it")
    job_id = f"d-{secrets.token_hex(12)}"
    row = {
        "id": job_id, "owner": owner,
        "request": msgspec.json.encode(wanted).decode(), "state": "queued", "progress": 0.0,
        "file": "", "bytes": 0, "notes": "[]", "error": "", "asked_ns": now_ns,
    }  # fmt: skip
    connection.execute(JOB.insert(), [row])
    found = find(connection, job_id)
    assert found is not None
    return found


def find(connection: Connection, job_id: str) -> DownloadJob | None:
    """Return a download, or None."""
    row = connection.execute(select(JOB).where(JOB.c.id == job_id)).one_or_none()
    return None if row is None else _job(row)


def find_all(connection: Connection, ids: Sequence[str]) -> dict[str, DownloadJob]:
    """Return downloads by their ids."""
    rows = connection.execute(select(JOB).where(JOB.c.id.in_(ids)))
    return {row.id: _job(row) for row in rows}


def listed(
    connection: Connection, owner: str | None, after: str = "", limit: int = 100
) -> list[DownloadJob]:
    """Return downloads of an owner (None: of all), newest first, those after an id."""
    chosen = select(JOB).order_by(JOB.c.asked_ns.desc(), JOB.c.id).limit(limit)
    if owner is not None:
        chosen = chosen.where(JOB.c.owner == owner)
    mark = find(connection, after) if after else None
    if mark is not None:
        older = JOB.c.asked_ns < mark.asked_ns
        same = (JOB.c.asked_ns == mark.asked_ns) & (JOB.c.id > mark.id)
        chosen = chosen.where(older | same)
    return [_job(row) for row in connection.execute(chosen)]


def next_one(connection: Connection) -> DownloadJob | None:
    """Return the download to make next: owners take turns, each one's oldest first."""
    queued = select(JOB).where(JOB.c.state == "queued").order_by(JOB.c.asked_ns, JOB.c.id)
    waiting = [_job(row) for row in connection.execute(queued)]
    served = select(JOB.c.owner, func.max(JOB.c.started_ns)).group_by(JOB.c.owner)
    last = {owner: started or 0 for owner, started in connection.execute(served)}
    return min(waiting, key=lambda job: (last.get(job.owner, 0), job.asked_ns), default=None)


def change(
    connection: Connection, job_id: str, *, only: Sequence[DownloadState], **values: Any
) -> bool:
    """Change a download that is in one of the states ``only``; return whether it was."""
    wanted = update(JOB).where(JOB.c.id == job_id, JOB.c.state.in_(only))
    return connection.execute(wanted.values(**values)).rowcount > 0


def begin_again(connection: Connection) -> None:
    """Queue the downloads again that were being made when the server stopped."""
    running = update(JOB).where(JOB.c.state == "running")
    connection.execute(running.values(state="queued", progress=0.0))


def outdated(connection: Connection, now_ns: int, options: Downloads) -> list[DownloadJob]:
    """Return finished downloads that are too old, and the oldest beyond the quota."""
    done = select(JOB).where(JOB.c.state == "done").order_by(JOB.c.ended_ns.desc(), JOB.c.id)
    found, size = [], 0
    for number, job in enumerate(map(_job, connection.execute(done))):
        size += job.bytes
        is_old = now_ns - (job.ended_ns or 0) > options.kept_h * 3600e9
        if is_old or (number and size > options.quota_gb * 1e9):
            found.append(job)
    return found


def forget(connection: Connection, now_ns: int) -> None:
    """Delete the rows of downloads that were requested too long ago and have no file."""
    old = JOB.c.asked_ns < now_ns - _REMEMBERED_NS
    connection.execute(JOB.delete().where(old, JOB.c.state.not_in((*OPEN, "done"))))


def _job(row: Row[Any]) -> DownloadJob:
    return DownloadJob(
        row.id,
        row.owner,
        msgspec.json.decode(row.request, type=DownloadRequest),
        row.state,
        row.progress,
        row.file,
        row.bytes,
        msgspec.json.decode(row.notes, type=list[str]),
        row.error,
        row.asked_ns,
        row.started_ns,
        row.ended_ns,
    )


SETTING = "downloads"
OP = "amberbox.server.data.worker_downloads:make"

_MEMORY_BYTES = 2 << 30


class DownloadProgress(msgspec.Struct, frozen=True):
    """The progress that a worker reports of a download."""

    progress: float
    file: str = ""
    bytes: int = 0
    notes: list[str] = []


class DownloadService(JobService[DownloadJob]):
    """Makes the queued downloads; interrupted ones are made again."""

    def path(self, job: DownloadJob) -> Path:
        """Return the path of a download's file."""
        return self._folder / FOLDER / job.id / job.file

    def begin_again(self, connection: Connection) -> None:
        """See ``JobService``."""
        begin_again(connection)

    def next_one(self, connection: Connection) -> DownloadJob | None:
        """See ``JobService``."""
        return next_one(connection)

    def change(
        self, connection: Connection, job_id: str, only: Sequence[OpenState], values: Any
    ) -> bool:
        """See ``JobService``."""
        return change(connection, job_id, only=only, **values)

    def task(self, job: DownloadJob, receive: Callable[[bytes], None]) -> WorkerTask:
        """See ``JobService``."""
        with self._database.reading() as connection:
            options = read(connection, SETTING, Downloads)
        arguments = {
            "id": job.id, "wanted": msgspec.to_builtins(job.wanted), "asked_ns": job.asked_ns,
            "most_bytes": int(options.each_gb * 1e9),
        }  # fmt: skip
        return WorkerTask(OP, arguments, receive, options.limit_h * 3600, _MEMORY_BYTES)

    def progress(self, part: bytes) -> tuple[float, Mapping[str, Any]]:
        """See ``JobService``."""
        made = msgspec.json.decode(part, type=DownloadProgress)
        notes = msgspec.json.encode(made.notes).decode()
        return made.progress, {"file": made.file, "bytes": made.bytes, "notes": notes}

    def tidy(self) -> None:
        """Delete the files of downloads that are too old, beyond the quota, or unfinished."""
        now_ns = self._clock.wall_ns()
        with self._database.begin() as connection:
            options = read(connection, SETTING, Downloads)
            for job in outdated(connection, now_ns, options):
                change(connection, job.id, only=["done"], state="expired")
            forget(connection, now_ns)
            kept = {job.id for job in listed(connection, None, limit=10_000)
                    if job.state == "done"}  # fmt: skip
        folder = self._folder / FOLDER
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name not in kept and not self.is_running(path.name):
                shutil.rmtree(path, ignore_errors=True)
