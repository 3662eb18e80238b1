"""Learnt models: asked for by people, learnt one at a time by a worker, kept in versions."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Row, func, select, update

from amberbox.core.api import ModelState
from amberbox.core.errors import UsageError
from amberbox.server.schema import MODEL
from amberbox.server.workers.jobs import OPEN, JobService, OpenState
from amberbox.server.workers.protocol import WorkerTask

FOLDER = "models"
"""Below the server's data folder: one folder per model."""
ENDING = ".model"
MOST_MODELS = 500
MOST_WAITING = 5
"""Models that wait or are learnt, of one person."""

_DELETED = "deleted"
_OP = "amberbox.server.learning.worker:learn"
_LIMIT_S = 2 * 3600.0
_MEMORY_BYTES = 2 << 30


class LearnRequest(msgspec.Struct, frozen=True):
    """Which detectors to learn, from which missions of which robots.

    ``missions`` are names or ids, all that did not fail without; ``options`` are plain values by
    detector. Only what arrived in ``[from_ns, to_ns)`` counts. Of a ``team`` the robots are learnt
    side by side.
    """

    robots: list[str]
    detectors: list[str]
    missions: list[str] = []
    from_ns: int | None = None
    to_ns: int | None = None
    false_alarms_per_hour: float = 1.0
    options: dict[str, Any] = {}
    team: bool = False


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A row of the table: a model and its state."""

    id: str
    name: str
    version: int
    owner: str
    wanted: LearnRequest
    state: ModelState
    progress: float
    bytes: int
    sha256: str
    report: list[str]
    error: str
    asked_ns: int
    started_ns: int | None
    ended_ns: int | None

    @property
    def file(self) -> str:
        """Return the name of its file."""
        return f"{self.name}-v{self.version}{ENDING}"


def add(
    connection: Connection, now_ns: int, owner: str, name: str, wanted: LearnRequest
) -> StoredModel:
    """Queue a model, as the next version of its name.

    Raises UsageError when the owner has too many waiting, or the server has too many models.
    """
    count = select(func.count()).select_from(MODEL).where(MODEL.c.state != _DELETED)
    if (connection.scalar(count) or 0) >= MOST_MODELS:
        raise UsageError(f"the server keeps {MOST_MODELS} models", "delete some of them")
    waiting = count.where(MODEL.c.owner == owner, MODEL.c.state.in_(OPEN))
    if (number := connection.scalar(waiting) or 0) >= MOST_WAITING:
        raise UsageError(f"{number} of your models are being learnt", "wait for one, or cancel it")
    newest = select(func.max(MODEL.c.version)).where(MODEL.c.name == name)
    model_id = f"m-{secrets.token_hex(12)}"
    row = {
        "id": model_id, "name": name, "version": (connection.scalar(newest) or 0) + 1,
        "owner": owner, "request": msgspec.json.encode(wanted).decode(), "state": "queued",
        "progress": 0.0, "bytes": 0, "sha256": "", "report": "[]", "error": "", "asked_ns": now_ns,
    }  # fmt: skip
    connection.execute(MODEL.insert(), [row])
    found = find(connection, model_id)
    assert found is not None
    return found


def find(connection: Connection, model_id: str) -> StoredModel | None:
    """Return a model, or None."""
    chosen = select(MODEL).where(MODEL.c.id == model_id, MODEL.c.state != _DELETED)
    row = connection.execute(chosen).one_or_none()
    return None if row is None else _model(row)


def listed(connection: Connection, name: str = "") -> list[StoredModel]:
    """Return all models, or those of one name, newest first."""
    chosen = select(MODEL).where(MODEL.c.state != _DELETED)
    chosen = chosen.order_by(MODEL.c.asked_ns.desc(), MODEL.c.version.desc())
    chosen = chosen.where(MODEL.c.name == name) if name else chosen
    return [_model(row) for row in connection.execute(chosen)]


def change(
    connection: Connection, model_id: str, *, only: Sequence[ModelState], **values: Any
) -> bool:
    """Change a model that is in one of the states ``only``; return whether it was."""
    wanted = update(MODEL).where(MODEL.c.id == model_id, MODEL.c.state.in_(only))
    return connection.execute(wanted.values(**values)).rowcount > 0


def delete(connection: Connection, model_id: str) -> None:
    """Forget a model, but not that its version was used; its file goes with the next ``tidy``."""
    nothing = msgspec.json.encode(LearnRequest([], [])).decode()
    empty = {"state": _DELETED, "request": nothing, "report": "[]", "error": ""}
    connection.execute(update(MODEL).where(MODEL.c.id == model_id).values(**empty))


def _model(row: Row[Any]) -> StoredModel:
    return StoredModel(
        row.id, row.name, row.version, row.owner,
        msgspec.json.decode(row.request, type=LearnRequest), row.state, row.progress, row.bytes,
        row.sha256, msgspec.json.decode(row.report, type=list[str]), row.error, row.asked_ns,
        row.started_ns, row.ended_ns,
    )  # fmt: skip


class LearningProgress(msgspec.Struct, frozen=True):
    """What a worker reports: how far it is, at the end also the file's size and hash."""

    progress: float
    bytes: int = 0
    sha256: str = ""
    report: list[str] = []


class LearningService(JobService[StoredModel]):
    """Learns the queued models."""

    def path(self, model: StoredModel) -> Path:
        """Return the path of a model's file."""
        return self._folder / FOLDER / model.id / model.file

    def begin_again(self, connection: Connection) -> None:
        """See ``JobService``."""
        running = update(MODEL).where(MODEL.c.state == "running")
        connection.execute(running.values(state="queued", progress=0.0))

    def next_one(self, connection: Connection) -> StoredModel | None:
        """See ``JobService``: the oldest; of one person only a few wait."""
        queued = select(MODEL).where(MODEL.c.state == "queued").order_by(MODEL.c.asked_ns)
        row = connection.execute(queued.limit(1)).one_or_none()
        return None if row is None else _model(row)

    def change(
        self, connection: Connection, job_id: str, only: Sequence[OpenState], values: Any
    ) -> bool:
        """See ``JobService``."""
        return change(connection, job_id, only=only, **values)

    def task(self, job: StoredModel, receive: Callable[[bytes], None]) -> WorkerTask:
        """See ``JobService``."""
        arguments = {
            "id": job.id, "file": job.file, "name": job.name, "version": job.version,
            "wanted": msgspec.to_builtins(job.wanted),
        }  # fmt: skip
        return WorkerTask(_OP, arguments, receive, _LIMIT_S, _MEMORY_BYTES)

    def progress(self, part: bytes) -> tuple[float, Mapping[str, Any]]:
        """See ``JobService``."""
        made = msgspec.json.decode(part, type=LearningProgress)
        report = msgspec.json.encode(made.report).decode()
        return made.progress, {"bytes": made.bytes, "sha256": made.sha256, "report": report}

    def tidy(self) -> None:
        """Delete the files of models that were deleted, or are not finished."""
        with self._database.reading() as connection:
            kept = {model.id for model in listed(connection) if model.state == "done"}
        folder = self._folder / FOLDER
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name not in kept and not self.is_running(path.name):
                shutil.rmtree(path, ignore_errors=True)
