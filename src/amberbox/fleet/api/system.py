"""Teams and the system, watched on the server: how they are, what is broken in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Query

from amberbox.core.timetext import format_time
from amberbox.core.types import Status
from amberbox.fleet.api.access import Fleet, Routes
from amberbox.fleet.api.diagnoses import DiagnosisLine, line_of, revision_json
from amberbox.fleet.system import reading
from amberbox.fleet.system.system import Watched

routes = Routes("system")


@dataclass(frozen=True, slots=True)
class FileProblem:
    """What is wrong in a file of a folder."""

    file: str
    line: int
    where: str
    what: str
    hint: str
    is_error: bool


@dataclass(frozen=True, slots=True)
class SystemComponent:
    """How a component of a team or of the system is; with ``mode`` one monitor of it."""

    component: str
    mode: str
    level: str
    state: str
    reason: str
    blocked_by: list[str]
    measured: str
    since: str


@dataclass(frozen=True, slots=True)
class SystemFolder:
    """A team, or the system: whether it is watched, and what its watcher says."""

    name: str
    state: str
    restarts: int
    trouble: str
    members: list[str]
    problems: list[FileProblem]
    statuses: list[SystemComponent]


@dataclass(frozen=True, slots=True)
class SystemDiagnosis:
    """A diagnosis of a team or of the system; ``last`` is all of its last revision."""

    name: str
    diagnosis: DiagnosisLine
    last: dict[str, Any]


@routes.get("/system/status", "status.read")
def read_status(fleet: Fleet) -> list[SystemFolder]:
    """Return how teams and the system are, teams first; nothing if none is set up."""
    return [_folder(watched) for watched in fleet.system.watched()]


@routes.get("/system/diagnoses", "diagnoses.read")
def list_system_diagnoses(
    fleet: Fleet, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> list[SystemDiagnosis]:
    """List what is, or was, broken in teams and in the system, the newest of each first."""
    return [
        SystemDiagnosis(watched.place.name, line_of(known), revision_json(known.last))
        for watched in fleet.system.watched()
        for known in reading.diagnoses(watched.place.store)[:limit]
    ]


def _folder(watched: Watched) -> SystemFolder:
    place = watched.place
    problems = [
        FileProblem(_inside(p.file, str(place.path)), p.line, p.where, p.what, p.hint, p.is_error)
        for p in place.problems
    ]
    return SystemFolder(
        place.name, "refused" if place.store is None else watched.state, watched.restarts,
        watched.trouble.replace(f"{place.path}/", ""), sorted(place.members), problems,
        [_component(status) for status in reading.statuses(place.store)],
    )  # fmt: skip


def _inside(file: str, folder: str) -> str:
    return file.removeprefix(folder).lstrip("/")


def _component(status: Status) -> SystemComponent:
    return SystemComponent(
        status.component, status.mode, status.level, status.state, status.reason,
        list(status.blocked_by), format_time(status.measured_ns), format_time(status.since_ns),
    )  # fmt: skip
