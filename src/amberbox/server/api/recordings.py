"""Routes of recordings: journals of a robot, windows fetched from it, and downloads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import msgspec
from fastapi import HTTPException, Path, Query
from fastapi.responses import FileResponse
from pydantic import Field
from sqlalchemy import Connection

from amberbox.core.api import CommandLine, Download, DownloadFormat, Fetch, Recording
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import maybe_time
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.archive.retention import rule_of
from amberbox.server.bus import ServerChange
from amberbox.server.data import downloads
from amberbox.server.data.downloads import SETTING, DownloadJob, DownloadRequest, Downloads
from amberbox.server.data.query import WORKER
from amberbox.server.data.recordings import JournalListing as Kept
from amberbox.server.data.recordings import recordings
from amberbox.server.http.auth import Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import ITEM, Form, Id, Limit, download_headers
from amberbox.server.ingest import fetches
from amberbox.server.ingest.fetches import RequestedWindow
from amberbox.server.journals import Retention
from amberbox.server.services import recordings as services
from amberbox.server.services.context import Caller, Services, robot_span_ns
from amberbox.server.services.recordings import (
    download_line,
    fetch_line,
    hidden_downloads,
    is_admin,
)
from amberbox.server.settings import read

recording_routes = Routes("recordings")

_CHECKED = 50


@recording_routes.get("/robots/{robot}/recordings", "items.read")
def list_recordings(
    fleet: Fleet, who: Who, robot: OfRobot, limit: Limit = 100,
    after: Annotated[
        str, Query(max_length=400, description="store_id/journal of the last one before")
    ] = "",
    check: Annotated[
        bool, Query(description=f"read each, at most {_CHECKED}, and compare its hash")
    ] = False,
) -> list[Recording]:  # fmt: skip
    """List the journals of a robot by name; without ``check`` their integrity is as last known."""
    if check and limit > _CHECKED:
        raise HTTPException(400, f"at most {_CHECKED} are checked at a time: give limit")
    with fleet.database.reading() as connection:
        found = recordings(connection, fleet.folder, robot.id, after, limit)
        rules = read(connection, "retention", tuple[Retention, ...])
    checked = _checked(fleet, who, robot.id, found) if check else found
    return [_shown(one, robot.id, rules) for one in checked]


def _checked(fleet: Services, who: Caller, robot: str, found: Sequence[Kept]) -> Sequence[Kept]:
    named = [
        [one.store_id, one.journal, one.sha256]
        for one in found
        if one.integrity in ("intact", "unsigned")
    ]
    arguments = {"robot": robot, "journals": named}
    answer = fleet.worker_pool.ask_now(f"{WORKER}:altered", arguments, origin=who.person)
    altered = set(msgspec.json.decode(answer, type=list[str]))
    return [
        replace(one, integrity="altered") if f"{one.store_id}/{one.journal}" in altered else one
        for one in found
    ]


def _shown(one: Kept, robot: str, rules: Sequence[Retention]) -> Recording:
    rule = rule_of(robot, one.keeping, rules)
    until = [
        None if seconds is None or one.came_ns is None else one.came_ns + int(seconds * NS)
        for seconds in (rule.journals_s, rule.columns_s)
    ] if rule is not None else [None, None]  # fmt: skip
    return Recording(
        store_id=one.store_id, journal=one.journal, keeping=one.keeping, sha256=one.sha256,
        state=one.state, integrity=one.integrity, reason=one.reason, bytes=one.bytes,
        copied=one.copied, rows=one.rows, from_=maybe_time(one.from_ns),
        to=maybe_time(one.to_ns), came=maybe_time(one.came_ns), journal_until=maybe_time(until[0]),
        columns_until=maybe_time(until[1]),
    )  # fmt: skip


class JournalAgain(Form):
    """A journal that is to be sent again; ``store_id`` is that of the present store if empty."""

    journal: Annotated[
        str, Field(pattern=r"^[a-z]{1,16}/[0-9]{1,12}-[0-9a-z]{1,16}-[0-9]{1,12}\.mcap$")
    ]
    store_id: Annotated[str, Field(max_length=64)] = ""


@recording_routes.post("/robots/{robot}/recordings/copy", "data.fetch", status_code=202)
def copy_again(fleet: Fleet, who: Who, robot: OfRobot, body: JournalAgain) -> CommandLine:
    """Let the robot send a journal again that is damaged, missing or quarantined here."""
    return services.copy_again(fleet, who, robot, body.journal, body.store_id)


@recording_routes.post("/robots/{robot}/recordings/rotate", "data.fetch", status_code=202)
def rotate(fleet: Fleet, who: Who, robot: OfRobot) -> CommandLine:
    """Let the recorder begin new files at once, so that what it has written can be copied."""
    return services.rotate(fleet, who, robot)


fetch_routes = Routes("fetches")

FetchId = Annotated[str, Path(pattern=r"^f-[0-9a-f]{24}$")]
TimeField = Annotated[str, Field(min_length=1, max_length=64)]


class NewFetch(Form):
    """A window of an item, of all items without a name."""

    item: Annotated[str, Field(pattern=rf"{ITEM}|^$")] = ""
    from_: Annotated[TimeField, Field(alias="from")]
    to: TimeField


@fetch_routes.post("/robots/{robot}/fetches", "data.fetch", status_code=202)
def ask_robot(fleet: Fleet, who: Who, robot: OfRobot, new: NewFetch) -> Fetch:
    """Ask a robot for a window of its record: now, or as soon as it is connected."""
    from_ns, to_ns = robot_span_ns(fleet, robot.id, new.from_, new.to)
    if from_ns is None or to_ns is None:
        raise UsageError("a window has a beginning and an end", "give from and to")
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        one = fetches.add(connection, now_ns, robot.id, by, new.item, (from_ns, to_ns))
        details = {
            "id": one.id,
            "item": new.item,
            "from": maybe_time(from_ns),
            "to": maybe_time(to_ns),
        }
        who.note(connection, now_ns, "data.fetch", robot.id, details=details)
    fleet.bus.publish(ServerChange("fetch", one.robot, {"id": one.id, "ask": True}))
    return fetch_line(one)


@fetch_routes.get("/robots/{robot}/fetches", "data.query")
def list_fetches(
    fleet: Fleet, robot: OfRobot, limit: Limit = 100,
    after: Annotated[str, Query(max_length=64, description="the last id of the page before")] = "",
) -> list[Fetch]:  # fmt: skip
    """List what was asked of a robot, newest first."""
    return services.list_fetches(fleet, robot, limit, after)


@fetch_routes.get("/robots/{robot}/fetches/{id}", "data.query")
def read_fetch(fleet: Fleet, robot: OfRobot, id: FetchId) -> Fetch:
    """Tell how far it is."""
    with fleet.database.reading() as connection:
        return fetch_line(_find(connection, robot, id))


@fetch_routes.delete("/robots/{robot}/fetches/{id}", "data.fetch")
def cancel_fetch(fleet: Fleet, who: Who, robot: OfRobot, id: FetchId) -> Fetch:
    """Want it no more; journals that the robot has marked already may still come."""
    with fleet.database.begin() as connection:
        one, now_ns = _find(connection, robot, id), fleet.clock.wall_ns()
        if fetches.cancel(connection, now_ns, one):
            who.note(connection, now_ns, "data.fetch.cancel", robot.id, details={"id": id})
        one = _find(connection, robot, id)
    fleet.bus.publish(ServerChange("fetch", one.robot, {"id": one.id, "ask": False}))
    return fetch_line(one)


def _find(connection: Connection, robot: KnownRobot, fetch_id: str) -> RequestedWindow:
    found = fetches.find(connection, robot.id, fetch_id)
    if found is None:
        raise HTTPException(404, f"nothing like this was asked of {robot.id}")
    return found


download_routes = Routes("downloads")

ItemText = Annotated[str, Field(pattern=ITEM)]
VariableTexts = Annotated[list[Annotated[str, Field(max_length=300)]], Field(max_length=256)]
MissionText = Annotated[str, Field(max_length=80)]
OptionalTime = Annotated[str, Field(max_length=64)]
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
    from_: Annotated[OptionalTime, Field(alias="from")] = ""
    to: OptionalTime = ""
    format: DownloadFormat = "csv"


@download_routes.post("/downloads", "data.download", each=True, status_code=202)
def ask_download(fleet: Fleet, who: Who, new: NewDownload) -> Download:
    """Ask for a download: it is made in the background, and told of in the feed when done."""
    wanted = _wanted(fleet, new)
    with fleet.database.begin() as connection:
        _check_robots(connection, who, wanted)
        now_ns, options = fleet.clock.wall_ns(), read(connection, SETTING, Downloads)
        job = downloads.add(connection, now_ns, who.person, wanted, options)
        about = {"robots": wanted.robots, "items": wanted.items, "missions": wanted.missions,
                 "from": maybe_time(wanted.from_ns), "to": maybe_time(wanted.to_ns),
                 "format": wanted.format}  # fmt: skip
        who.note(connection, now_ns, "downloads.ask", job.id, details=about)
    fleet.bus.publish(ServerChange("job", "", {"id": job.id, "owner": job.owner}))
    return download_line(job)


@download_routes.get("/downloads", "data.download", each=True)
def list_downloads(
    fleet: Fleet, who: Who, limit: Limit = 100,
    after: Annotated[str, Query(max_length=64, description="the last id of the page before")] = "",
    all: Annotated[bool, Query(description="those of others, too: for admins")] = False,
) -> list[Download]:  # fmt: skip
    """List one's own downloads, newest first."""
    return services.list_downloads(fleet, who, limit, after, all=all)


@download_routes.get("/downloads/{id}", "data.download", each=True)
def read_download(fleet: Fleet, who: Who, id: JobId) -> Download:
    """Tell how far a download is."""
    with fleet.database.reading() as connection:
        return download_line(_find_download(connection, who, id))


@download_routes.delete("/downloads/{id}", "data.download", each=True)
def cancel_download(fleet: Fleet, who: Who, id: JobId) -> Download:
    """Stop making a download, or throw it away when it is done."""
    with fleet.database.begin() as connection:
        job, now_ns = _find_download(connection, who, id), fleet.clock.wall_ns()
        ended = {"ended_ns": now_ns, "progress": 0.0}
        downloads.change(connection, id, only=downloads.OPEN, state="cancelled", **ended)
        downloads.change(connection, id, only=["done"], state="expired")
        who.note(connection, now_ns, "downloads.cancel", id)
        job = _find_download(connection, who, id)
    fleet.jobs.cancel(job)
    fleet.bus.publish(ServerChange("job", "", {"id": job.id, "owner": job.owner}))
    return download_line(job)


@download_routes.get(
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
        job = _find_download(connection, who, id)
        path = fleet.jobs.path(job)
        if job.state != "done" or not path.is_file():
            raise HTTPException(404, f"there is no file: the download is {job.state}")
        _check_robots(connection, who, job.wanted)
        details = {"file": job.file, "bytes": job.bytes}
        who.note(connection, fleet.clock.wall_ns(), "downloads.fetch", id, details=details)
    return FileResponse(
        path, media_type="application/octet-stream", headers=download_headers(job.file)
    )


def _wanted(fleet: Services, new: NewDownload) -> DownloadRequest:
    if new.missions and (new.from_ or new.to):
        raise UsageError("missions have their own times", "leave out from and to")
    if new.variables and new.format in ("mcap", "journals"):
        raise UsageError("messages are whole, not single variables", "choose csv or parquet")
    span = robot_span_ns(fleet, new.robots[0], new.from_, new.to)
    robots = list(dict.fromkeys(new.robots))
    return DownloadRequest(robots, new.format, new.items, new.variables, new.missions, *span)


def _check_robots(connection: Connection, who: Caller, wanted: DownloadRequest) -> None:
    """Raise 404 for a robot that the caller may not download from (any more)."""
    allowed = {robot.id for robot in who.robots(connection, "data.download")}
    for robot in wanted.robots:
        if robot not in allowed:
            raise HTTPException(404, f"there is no robot {robot!r}, or not for you")


def _find_download(connection: Connection, who: Caller, job_id: str) -> DownloadJob:
    job = downloads.find(connection, job_id)
    if job is None or not (job.owner == who.person or is_admin(who)):
        raise HTTPException(404, "there is no such download, or not for you")
    if hidden_downloads(connection, who, [job]):
        raise HTTPException(404, "there is no such download, or not for you")
    return job
