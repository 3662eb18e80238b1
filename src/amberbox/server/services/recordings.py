"""Missions, notes, incidents, gaps, fetches and downloads as API and pages show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from pydantic import TypeAdapter
from sqlalchemy import Connection

from amberbox.blackbox.retention.missions import RecordedMission as KnownMission
from amberbox.blackbox.retention.missions import choose
from amberbox.core.api import (
    Download,
    Fetch,
    FetchedJournal,
    Gaps,
    Incident,
    Mission,
    MomentNote,
    Note,
)
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.server import annotations as server_annotations
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.annotations import MarkedIncident, MomentAnnotation
from amberbox.server.data import downloads
from amberbox.server.data.downloads import DownloadJob
from amberbox.server.data.query import WORKER, RowQuery, arguments
from amberbox.server.ingest import fetches
from amberbox.server.ingest.fetches import RequestedWindow
from amberbox.server.services.context import Caller, Services, robot_span_ns

_BEYOND_NS = 2**63
"""Times are 64 bits."""
_RELEASED = "released"
_GAPS = TypeAdapter(Gaps)


def list_missions(
    fleet: Services, who: Caller, robot: KnownRobot, name: str = "", *, failed: bool = False,
    from_: str = "", to: str = "", limit: int = 100, after: str = "",
) -> list[Mission]:  # fmt: skip
    """List the missions of a robot that meet a range of time, newest first."""
    span = robot_span_ns(fleet, robot.id, from_, to)
    known = known_missions(fleet, who, robot.id)
    found = choose(known, name or None, failed=failed, span=span)[::-1]
    ids = [mission.id for mission in found]
    start = ids.index(after) + 1 if after in ids else 0
    with fleet.database.reading() as connection:
        return mission_lines(connection, robot.id, found[start : start + limit])


def known_missions(fleet: Services, who: Caller, robot: str) -> list[KnownMission]:
    """Return the missions of a robot, its own and those that were begun here."""
    answer = fleet.worker_pool.ask_now(f"{WORKER}:missions", {"robot": robot}, origin=who.person)
    return msgspec.msgpack.decode(answer, type=list[KnownMission])


def mission_lines(
    connection: Connection, robot: str, found: Sequence[KnownMission]
) -> list[Mission]:
    """Return missions for a list, with their notes."""
    noted = server_annotations.mission_annotations(
        connection, robot, [mission.id for mission in found]
    )
    ours = {mission.id for mission in server_annotations.missions(connection, robot)}
    return [
        Mission(
            id=m.id, name=m.name, origin="server" if m.id in ours else "robot",
            from_=format_time(m.from_ns), to=maybe_time(m.to_ns), outcome=m.outcome,
            failed=m.failed, who=m.who, parameters=dict(m.parameters),
            notes=[Note(at=format_time(n.at_ns), who=n.who, text=n.text)
                   for n in noted.get(m.id, ())],
        )
        for m in found
    ]  # fmt: skip


def list_notes(
    fleet: Services, robot: KnownRobot, from_: str = "", to: str = "", limit: int = 100,
    after: int | None = None,
) -> list[MomentNote]:  # fmt: skip
    """List the notes on moments of a range of time, newest first; those on missions, too."""
    span = robot_span_ns(fleet, robot.id, from_, to)
    with fleet.database.reading() as connection:
        found = server_annotations.moment_annotations(connection, robot.id, span, after, limit)
    return [note_line(one) for one in found]


def note_line(one: MomentAnnotation) -> MomentNote:
    """Return a note on a moment in its published form."""
    return MomentNote(
        id=one.number, at=format_time(one.at_ns), who=one.who, text=one.text, mission=one.mission
    )


def list_incidents(
    fleet: Services, who: Caller, robot: KnownRobot, from_: str = "", to: str = "",
    limit: int = 100, after: str = "",
) -> list[Incident]:  # fmt: skip
    """List the incidents of a robot that meet a range of time, newest first."""
    from_ns, to_ns = robot_span_ns(fleet, robot.id, from_, to)
    answer = fleet.worker_pool.ask_now(
        f"{WORKER}:incidents", {"robot": robot.id}, origin=who.person
    )
    incidents = [_of_robot(values) for values in msgspec.json.decode(answer)]
    with fleet.database.reading() as connection:
        incidents += [
            marked_incident(one) for one in server_annotations.incidents(connection, robot.id)
        ]
    low, high = (None if ns is None else format_time(ns) for ns in (from_ns, to_ns))
    found = [
        one for one in incidents
        if (low is None or one.to > low) and (high is None or one.from_ < high)
    ]  # fmt: skip
    found.sort(key=lambda one: (one.from_, one.id), reverse=True)
    ids = [one.id for one in found]
    start = ids.index(after) + 1 if after in ids else 0
    return found[start : start + limit]


def _of_robot(values: Mapping[str, Any]) -> Incident:
    texts = {name: str(values.get(name) or "") for name in ("id", "state", "reason", "who")}
    return Incident(
        origin="robot", trigger=str(values.get("trigger") or ""),
        from_=_time(values.get("from_ns")), to=_time(values.get("to_ns")),
        **texts,
    )  # fmt: skip


def _time(value: object) -> str:
    """Format a time that a robot sent; an invalid one becomes the epoch."""
    return format_time(value if isinstance(value, int) and abs(value) < _BEYOND_NS else 0)


def marked_incident(one: MarkedIncident) -> Incident:
    """Return a window that was marked on the server in its published form."""
    return Incident(
        id=one.id, origin="server", state="complete" if one.released_ns is None else _RELEASED,
        reason=one.reason, who=one.who, trigger="", from_=format_time(one.from_ns),
        to=format_time(one.to_ns),
    )  # fmt: skip


def list_gaps(
    fleet: Services, who: Caller, robot: KnownRobot, item: str = "", from_: str = "", to: str = "",
    limit: int = 1000,
) -> Gaps:  # fmt: skip
    """List the missing ranges of a robot's record with their reasons, in order of time."""
    span = robot_span_ns(fleet, robot.id, from_, to)
    question = RowQuery(robot.id, item, None, *span, limit=limit)
    answer = fleet.worker_pool.ask_now(f"{WORKER}:gaps", arguments(question), origin=who.person)
    return _GAPS.validate_json(answer)


def list_fetches(
    fleet: Services, robot: KnownRobot, limit: int = 100, after: str = ""
) -> list[Fetch]:
    """List the windows requested from a robot, newest first."""
    with fleet.database.reading() as connection:
        return [fetch_line(one) for one in fetches.listed(connection, robot.id, after, limit)]


def fetch_line(one: RequestedWindow) -> Fetch:
    """Return a window requested from a robot in its published form."""
    files = [
        FetchedJournal(store_id=f.store_id, journal=f.journal, bytes=f.bytes, state=f.state)
        for f in one.files
    ]
    return Fetch(
        id=one.id, robot=one.robot, item=one.item, from_=format_time(one.from_ns),
        to=format_time(one.to_ns), who=one.who, state=one.state, reason=one.reason,
        copied=sum(bool(file.state) for file in files), journals=files,
        asked=format_time(one.asked_ns), sent=maybe_time(one.sent_ns),
        ended=maybe_time(one.ended_ns),
    )  # fmt: skip


def list_downloads(
    fleet: Services, who: Caller, limit: int = 100, after: str = "", *, all: bool = False
) -> list[Download]:
    """List one's own downloads, newest first."""
    owner = None if all and is_admin(who) else who.person
    with fleet.database.reading() as connection:
        found = downloads.listed(connection, owner, after, limit)
        hidden = hidden_downloads(connection, who, found)
        return [download_line(job) for job in found if job.id not in hidden]


def hidden_downloads(connection: Connection, who: Caller, jobs: Sequence[DownloadJob]) -> set[str]:
    """Return which downloads a token does not see: those with robots that it is not for."""
    if who.principal.kind != "token" or who.principal.groups is None:
        return set()
    mine = {robot.id for robot in who.robots(connection, "data.download")}
    return {job.id for job in jobs if not mine.issuperset(job.wanted.robots)}


def is_admin(who: Caller) -> bool:
    """Return whether the caller is an admin of all robots, and not a program."""
    unrestricted = who.principal.groups is None
    return who.principal.kind == "user" and who.principal.role == Role.ADMIN and unrestricted


def download_line(job: DownloadJob) -> Download:
    """Return a download in its published form."""
    wanted = job.wanted
    return Download(
        job.id, job.owner, job.state, job.progress, wanted.robots, wanted.items, wanted.missions,
        wanted.format, job.file or None, job.bytes, job.notes, job.error,
        format_time(job.asked_ns), maybe_time(job.started_ns), maybe_time(job.ended_ns),
    )  # fmt: skip
