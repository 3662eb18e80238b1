"""Downloads in the database: asked for, made, kept, forgotten."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.errors import UsageError
from amberbox.fleet.jobs.tables import JOB
from amberbox.fleet.jobs.wanted import Downloads, Wanted

State = Literal["queued", "running", "done", "failed", "cancelled", "expired"]
OPEN: Sequence[State] = ("queued", "running")
_REMEMBERED_NS = 30 * 24 * 3600 * 10**9


@dataclass(frozen=True, slots=True)
class Job:
    """A download: who wants what, and what has become of it."""

    id: str
    owner: str
    wanted: Wanted
    state: State
    progress: float
    file: str
    bytes: int
    notes: list[str]
    error: str
    asked_ns: int
    started_ns: int | None
    ended_ns: int | None


def add(connection: Connection, now_ns: int, owner: str, wanted: Wanted, options: Downloads) -> Job:
    """Queue a download; raises UsageError when somebody has too many."""
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


def find(connection: Connection, job_id: str) -> Job | None:
    """Return a download."""
    row = connection.execute(select(JOB).where(JOB.c.id == job_id)).one_or_none()
    return None if row is None else _job(row)


def find_all(connection: Connection, ids: Sequence[str]) -> dict[str, Job]:
    """Return downloads by their ids."""
    rows = connection.execute(select(JOB).where(JOB.c.id.in_(ids)))
    return {row.id: _job(row) for row in rows}


def listed(
    connection: Connection, owner: str | None, after: str = "", limit: int = 100
) -> list[Job]:
    """Return downloads of somebody (of all: None), newest first, behind that of an id."""
    chosen = select(JOB).order_by(JOB.c.asked_ns.desc(), JOB.c.id).limit(limit)
    if owner is not None:
        chosen = chosen.where(JOB.c.owner == owner)
    mark = find(connection, after) if after else None
    if mark is not None:
        older = JOB.c.asked_ns < mark.asked_ns
        same = (JOB.c.asked_ns == mark.asked_ns) & (JOB.c.id > mark.id)
        chosen = chosen.where(older | same)
    return [_job(row) for row in connection.execute(chosen)]


def next_one(connection: Connection) -> Job | None:
    """Return what is to be made next: people take turns, each one's oldest first."""
    queued = select(JOB).where(JOB.c.state == "queued").order_by(JOB.c.asked_ns, JOB.c.id)
    waiting = [_job(row) for row in connection.execute(queued)]
    served = select(JOB.c.owner, func.max(JOB.c.started_ns)).group_by(JOB.c.owner)
    last = {owner: started or 0 for owner, started in connection.execute(served)}
    return min(waiting, key=lambda job: (last.get(job.owner, 0), job.asked_ns), default=None)


def change(connection: Connection, job_id: str, *, only: Sequence[State], **values: Any) -> bool:
    """Change a download that is in one of some states; tell whether it was."""
    wanted = update(JOB).where(JOB.c.id == job_id, JOB.c.state.in_(only))
    return connection.execute(wanted.values(**values)).rowcount > 0


def begin_again(connection: Connection) -> None:
    """Queue what was being made when the server stopped."""
    running = update(JOB).where(JOB.c.state == "running")
    connection.execute(running.values(state="queued", progress=0.0))


def outdated(connection: Connection, now_ns: int, options: Downloads) -> list[Job]:
    """Return finished downloads that are too old, or, oldest first, more than there is room for."""
    done = select(JOB).where(JOB.c.state == "done").order_by(JOB.c.ended_ns.desc(), JOB.c.id)
    found, size = [], 0
    for number, job in enumerate(map(_job, connection.execute(done))):
        size += job.bytes
        is_old = now_ns - (job.ended_ns or 0) > options.kept_h * 3600e9
        if is_old or (number and size > options.quota_gb * 1e9):
            found.append(job)
    return found


def forget(connection: Connection, now_ns: int) -> None:
    """Remove what ended a month ago."""
    old = JOB.c.asked_ns < now_ns - _REMEMBERED_NS
    connection.execute(JOB.delete().where(old, JOB.c.state.not_in((*OPEN, "done"))))


def _job(row: Row[Any]) -> Job:
    return Job(
        row.id, row.owner, msgspec.json.decode(row.request, type=Wanted), row.state, row.progress,
        row.file, row.bytes, msgspec.json.decode(row.notes, type=list[str]), row.error,
        row.asked_ns, row.started_ns, row.ended_ns,
    )  # fmt: skip
