"""Downloads: extracts of robots' data, made in the background, kept a day, seen by who asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException, Path, Query
from fastapi.responses import FileResponse
from pydantic import Field
from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.api.access import Caller, Fleet, Routes, Who
from amberbox.fleet.api.forms import Form, Id, Limit, download, shown
from amberbox.fleet.api.windows import ITEM, span_in
from amberbox.fleet.bus import Change
from amberbox.fleet.jobs import ledger
from amberbox.fleet.jobs.jobs import SETTING
from amberbox.fleet.jobs.ledger import Job, State
from amberbox.fleet.jobs.wanted import Downloads, Format, Wanted
from amberbox.fleet.options.options import read
from amberbox.fleet.services import Services

routes = Routes("downloads")

ItemText = Annotated[str, Field(pattern=ITEM)]
VariableTexts = Annotated[list[Annotated[str, Field(max_length=300)]], Field(max_length=256)]
MissionText = Annotated[str, Field(max_length=80)]
TimeField = Annotated[str, Field(max_length=64)]
JobId = Annotated[str, Path(pattern=r"^d-[0-9a-f]{24}$")]


class NewDownload(Form):
    """What to download: items (all without a name) of robots, in missions or in a range of time.

    ``variables`` names columns per item (csv and parquet). ``missions`` are ids, or ``last:3``,
    ``failed:3``, ``transport:3`` of each robot. ``mcap`` has the messages as they came,
    ``journals`` the files that the robots signed.
    """

    robots: Annotated[list[Id], Field(min_length=1, max_length=100)]
    items: Annotated[list[ItemText], Field(max_length=200, default_factory=list)]
    variables: Annotated[dict[ItemText, VariableTexts], Field(max_length=200, default_factory=dict)]
    missions: Annotated[list[MissionText], Field(max_length=200, default_factory=list)]
    from_: Annotated[TimeField, Field(alias="from")] = ""
    to: TimeField = ""
    format: Format = "csv"


@dataclass(frozen=True, slots=True)
class Download:
    """A download; ``progress`` goes from 0 to 1, ``file`` is there when the state is ``done``."""

    id: str
    owner: str
    state: State
    progress: float
    robots: list[str]
    items: list[str]
    missions: list[str]
    format: Format
    file: str | None
    bytes: int
    notes: list[str]
    error: str
    asked: str
    started: str | None
    ended: str | None


@routes.post("/downloads", "data.download", each=True, status_code=202)
def ask_download(fleet: Fleet, who: Who, new: NewDownload) -> Download:
    """Ask for a download: it is made in the background, and told of in the feed when done."""
    wanted = _wanted(fleet, new)
    with fleet.database.begin() as connection:
        _check_robots(connection, who, wanted)
        now_ns, options = fleet.clock.wall_ns(), read(connection, SETTING, Downloads)
        job = ledger.add(connection, now_ns, _owner(who), wanted, options)
        about = {"robots": wanted.robots, "items": wanted.items, "missions": wanted.missions,
                 "from": shown(wanted.from_ns), "to": shown(wanted.to_ns),
                 "format": wanted.format}  # fmt: skip
        who.note(connection, now_ns, "downloads.ask", job.id, details=about)
    _tell(fleet, job)
    return _shown(job)


@routes.get("/downloads", "data.download", each=True)
def list_downloads(
    fleet: Fleet, who: Who, limit: Limit = 100,
    after: Annotated[str, Query(max_length=64, description="the last id of the page before")] = "",
    all: Annotated[bool, Query(description="those of others, too: for admins")] = False,
) -> list[Download]:  # fmt: skip
    """List one's own downloads, newest first."""
    owner = None if all and _is_admin(who) else _owner(who)
    with fleet.database.reading() as connection:
        found = ledger.listed(connection, owner, after, limit)
        hidden = _hidden(connection, who, found)
        return [_shown(job) for job in found if job.id not in hidden]


@routes.get("/downloads/{id}", "data.download", each=True)
def read_download(fleet: Fleet, who: Who, id: JobId) -> Download:
    """Tell how far a download is."""
    with fleet.database.reading() as connection:
        return _shown(_find(connection, who, id))


@routes.delete("/downloads/{id}", "data.download", each=True)
def cancel_download(fleet: Fleet, who: Who, id: JobId) -> Download:
    """Stop making a download, or throw it away when it is done."""
    with fleet.database.begin() as connection:
        job, now_ns = _find(connection, who, id), fleet.clock.wall_ns()
        ended = {"ended_ns": now_ns, "progress": 0.0}
        ledger.change(connection, id, only=ledger.OPEN, state="cancelled", **ended)
        ledger.change(connection, id, only=["done"], state="expired")
        who.note(connection, now_ns, "downloads.cancel", id)
        job = _find(connection, who, id)
    fleet.jobs.cancel(job)
    _tell(fleet, job)
    return _shown(job)


@routes.get(
    "/downloads/{id}/file", "data.download", each=True, response_class=FileResponse,
    responses={
        200: {"description": "the file", "content": {"application/octet-stream": {}}},
        206: {"description": "a part of it, as the header Range asks"},
        416: {"description": "there is no such part"},
    },
)  # fmt: skip
def fetch_download(fleet: Fleet, who: Who, id: JobId) -> FileResponse:
    """Fetch the file of a download; ``Range`` goes on with what was cut short."""
    with fleet.database.begin() as connection:
        job = _find(connection, who, id)
        path = fleet.jobs.path(job)
        if job.state != "done" or not path.is_file():
            raise HTTPException(404, f"there is no file: the download is {job.state}")
        _check_robots(connection, who, job.wanted)
        details = {"file": job.file, "bytes": job.bytes}
        who.note(connection, fleet.clock.wall_ns(), "downloads.fetch", id, details=details)
    return FileResponse(path, media_type="application/octet-stream", headers=download(job.file))


def _wanted(fleet: Services, new: NewDownload) -> Wanted:
    if new.missions and (new.from_ or new.to):
        raise UsageError("missions have their own times", "leave out from and to")
    if new.variables and new.format in ("mcap", "journals"):
        raise UsageError("messages are whole, not single variables", "choose csv or parquet")
    span = span_in(fleet, new.robots[0], new.from_, new.to)
    robots = list(dict.fromkeys(new.robots))
    return Wanted(robots, new.format, new.items, new.variables, new.missions, *span)


def _check_robots(connection: Connection, who: Caller, wanted: Wanted) -> None:
    """Raise 404 for a robot that the caller may not download from (any more)."""
    allowed = {robot.id for robot in who.robots(connection, "data.download")}
    for robot in wanted.robots:
        if robot not in allowed:
            raise HTTPException(404, f"there is no robot {robot!r}, or not for you")


def _find(connection: Connection, who: Caller, job_id: str) -> Job:
    job = ledger.find(connection, job_id)
    if job is None or not (job.owner == _owner(who) or _is_admin(who)):
        raise HTTPException(404, "there is no such download, or not for you")
    if _hidden(connection, who, [job]):
        raise HTTPException(404, "there is no such download, or not for you")
    return job


def _hidden(connection: Connection, who: Caller, jobs: Sequence[Job]) -> set[str]:
    """Return which downloads a token does not see: those with robots that it is not for."""
    if who.principal.kind != "token" or who.principal.groups is None:
        return set()
    mine = {robot.id for robot in who.robots(connection, "data.download")}
    return {job.id for job in jobs if not mine.issuperset(job.wanted.robots)}


def _owner(who: Caller) -> str:
    """Return the person; what a token asked for belongs to who gave it."""
    return who.principal.owner or who.principal.id


def _is_admin(who: Caller) -> bool:
    unrestricted = who.principal.groups is None
    return who.principal.kind == "user" and who.principal.role == Role.ADMIN and unrestricted


def _tell(fleet: Services, job: Job) -> None:
    fleet.bus.publish(Change("job", "", {"id": job.id, "owner": job.owner}))


def _shown(job: Job) -> Download:
    wanted = job.wanted
    return Download(
        job.id, job.owner, job.state, job.progress, wanted.robots, wanted.items, wanted.missions,
        wanted.format, job.file or None, job.bytes, job.notes, job.error,
        format_time(job.asked_ns), shown(job.started_ns), shown(job.ended_ns),
    )  # fmt: skip
