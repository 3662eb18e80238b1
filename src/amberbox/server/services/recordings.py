"""Missions, notes, incidents, gaps, fetches and downloads as API and pages show them."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from pydantic import TypeAdapter
from sqlalchemy import Connection

from amberbox.blackbox.retention.missions import RecordedMission as KnownMission
from amberbox.blackbox.retention.missions import choose
from amberbox.core.api import (
    CommandLine,
    Download,
    Fetch,
    FetchedJournal,
    Gaps,
    Incident,
    Mission,
    MomentNote,
    Note,
)
from amberbox.core.errors import UsageError
from amberbox.core.notes import RecordedNote
from amberbox.core.record_commands import (
    IncidentMark,
    IncidentRelease,
    JournalCopy,
    JournalRotate,
    RecordCommand,
)
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.server import annotations as server_annotations
from amberbox.server import commands, record_orders
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.annotations import MarkedIncident, StoredNote
from amberbox.server.bus import ServerChange
from amberbox.server.commands import StoredCommand
from amberbox.server.data import downloads
from amberbox.server.data.downloads import DownloadJob
from amberbox.server.data.query import WORKER, RowQuery, arguments
from amberbox.server.ingest import fetches, link_state
from amberbox.server.ingest.fetches import RequestedWindow
from amberbox.server.ingest.uploads import copies_of, copy_matter, is_sound
from amberbox.server.record_orders import RecordOrder
from amberbox.server.services.commands import command_line
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


def note_line(one: StoredNote) -> MomentNote:
    """Return a note in its published form."""
    note = one.note
    return MomentNote(
        id=one.number, at=format_time(note.at_ns), who=note.who, text=note.text,
        mission=note.mission, note=note.id, to=maybe_time(note.to_ns), about=note.about,
        revision=note.revision,
    )  # fmt: skip


def write_note(
    fleet: Services, who: Caller, robot: KnownRobot, text: str, at: str = "", to: str = "",
    about: str = "", mission: str = "",
) -> MomentNote:  # fmt: skip
    """Write a note on a moment, a range or a mission, here and into the robot's record.

    Times are the robot's, as its data are; ``now`` is the server's. Raises UsageError.
    """
    at_ns, to_ns = robot_span_ns(fleet, robot.id, at, to)
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        if at_ns is None:
            at_ns = now_ns - (link_state.clock_offset_ns(connection, robot.id) or 0)
        if to_ns is not None and to_ns <= at_ns:
            raise UsageError("the range ends before it begins", "exchange at and to")
        note = _checked(
            RecordedNote(
                f"note-{secrets.token_hex(8)}", at_ns, record_orders.person_label(by), text, to_ns,
                about, mission, written_ns=now_ns,
            )
        )  # fmt: skip
        made = server_annotations.annotate(connection, robot.id, note)
        action = "missions.annotate" if mission else "notes.add"
        details = {"id": mission or made.number, "at": format_time(at_ns), "text": text}
        who.note(connection, now_ns, action, robot.id, details=details)
        is_sent = server_annotations.send_note(connection, now_ns, robot.id, note)
    _publish(fleet, robot.id, is_sent=is_sent)
    return note_line(made)


def change_note(
    fleet: Services, who: Caller, robot: KnownRobot, uid: str, text: str = "", *,
    withdrawn: bool = False,
) -> MomentNote:  # fmt: skip
    """Change the text of a note, or withdraw it, here and in the robot's record.

    Raises UsageError for a note that does not exist or is withdrawn.
    """
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        known = server_annotations.find_note(connection, robot.id, uid)
        if known is None or known.note.withdrawn:
            raise UsageError(f"there is no note '{uid}' of {robot.id}")
        note = _checked(
            msgspec.structs.replace(
                known.note, text=text or known.note.text, who=record_orders.person_label(by),
                revision=known.note.revision + 1, withdrawn=withdrawn, written_ns=now_ns,
            )
        )  # fmt: skip
        server_annotations.change_note(connection, robot.id, note)
        action = "notes.withdraw" if withdrawn else "notes.change"
        who.note(connection, now_ns, action, robot.id, details={"id": uid, "text": text})
        is_sent = server_annotations.send_note(connection, now_ns, robot.id, note)
    _publish(fleet, robot.id, is_sent=is_sent)
    return note_line(StoredNote(known.number, note))


def _checked(note: RecordedNote) -> RecordedNote:
    try:
        return msgspec.convert(msgspec.structs.asdict(note), RecordedNote)
    except msgspec.ValidationError as error:
        raise UsageError(f"this is no note: {error}") from error


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
        marked = server_annotations.incidents(connection, robot.id)
        orders = record_orders.found(connection, robot.id, [_about(one.id) for one in marked])
    incidents += [marked_incident(one, orders.get(_about(one.id))) for one in marked]
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


def mark_incident(
    fleet: Services, who: Caller, robot: KnownRobot, from_: str, to: str, reason: str
) -> Incident:
    """Mark a window, here and on the robot, where it is pinned in the ring as well.

    A window is in the robot's time, as its data are; ``now`` is the server's. Raises UsageError for
    a window without beginning or end.
    """
    from_ns, to_ns = robot_span_ns(fleet, robot.id, from_, to)
    if from_ns is None or to_ns is None:
        raise UsageError("a window has a beginning and an end", "give from and to")
    with fleet.database.begin() as connection:
        now_ns, by = fleet.clock.wall_ns(), str(who.principal)
        marked = server_annotations.mark(connection, now_ns, robot.id, (from_ns, to_ns), reason, by)
        details = {"id": marked.id, "from": format_time(from_ns), "to": format_time(to_ns),
                   "reason": reason}  # fmt: skip
        who.note(connection, now_ns, "incidents.mark", robot.id, details=details)
        ahead_ns = link_state.clock_offset_ns(connection, robot.id) or 0
        start_ns, end_ns = (
            ns - ahead_ns if text.strip().startswith("now") else ns
            for text, ns in ((from_, from_ns), (to, to_ns))
        )
        who_label = record_orders.person_label(by)
        wanted = IncidentMark(marked.id, start_ns, end_ns, who_label, reason)
        about = _about(marked.id)
        is_sent = record_orders.order(connection, now_ns, robot.id, about, wanted, by)
        order = record_orders.find(connection, robot.id, about)
    _publish(fleet, robot.id, is_sent=is_sent)
    return marked_incident(marked, order)


def release_incident(fleet: Services, who: Caller, robot: KnownRobot, id: str) -> Incident:
    """Release a window that was marked here, on the robot, too; raises UsageError."""
    with fleet.database.begin() as connection:
        now_ns, about = fleet.clock.wall_ns(), _about(id)
        released = server_annotations.release(connection, now_ns, robot.id, id)
        who.note(connection, now_ns, "incidents.release", robot.id, details={"id": id})
        is_sent, before = False, record_orders.find(connection, robot.id, about)
        if before is not None and before.state != "refused":
            by = str(who.principal)
            wanted = IncidentRelease(id, record_orders.person_label(by))
            is_sent = record_orders.order(connection, now_ns, robot.id, about, wanted, by)
        order = record_orders.find(connection, robot.id, about)
    _publish(fleet, robot.id, is_sent=is_sent)
    return marked_incident(released, order)


def _publish(fleet: Services, robot: str, *, is_sent: bool) -> None:
    fleet.bus.publish(ServerChange("robot", robot))
    if is_sent:
        fleet.bus.publish(ServerChange("command", robot, {"ids": []}))


def _about(incident: str) -> str:
    return f"incident:{incident}"


def _on_robot(order: RecordOrder | None) -> str:
    """Return what a robot does with an incident of the server."""
    if order is None or order.state == "withdrawn":
        return ""
    if order.state in ("waiting", "sent", "accepted"):
        return "asked"
    if order.state != "done":
        return f"{order.state}: {order.reason}" if order.reason else order.state
    return "pinned" if isinstance(order.wanted, IncidentMark) else "released"


def marked_incident(one: MarkedIncident, order: RecordOrder | None = None) -> Incident:
    """Return a window that was marked on the server in its published form."""
    return Incident(
        id=one.id, origin="server", state="complete" if one.released_ns is None else _RELEASED,
        reason=one.reason, who=one.who, trigger="", from_=format_time(one.from_ns),
        to=format_time(one.to_ns), on_robot=_on_robot(order),
    )  # fmt: skip


def copy_again(
    fleet: Services, who: Caller, robot: KnownRobot, journal: str, store_id: str = ""
) -> CommandLine:
    """Let a robot send a journal again that is damaged, missing or quarantined here.

    ``store_id`` is that of the robot's present store if it is empty. Raises UsageError where the
    copy here is what the robot has signed, or the robot cannot send it.
    """
    with fleet.database.begin() as connection:
        now_ns, present = fleet.clock.wall_ns(), link_state.store_of(connection, robot.id)
        if not present or (store_id and store_id != present):
            raise UsageError(f"{robot.id} has another store now", "what is in it is listed")
        sha256 = _expected_sha256(connection, fleet, robot.id, present, journal)
        wanted, about = JournalCopy(journal, sha256), copy_matter(present, journal)
        command = _order(connection, now_ns, robot.id, about, wanted, who)
        details = {"journal": journal, "command": command.id}
        who.note(connection, now_ns, "recordings.copy", robot.id, details=details)
    _publish(fleet, robot.id, is_sent=True)
    return command_line(command)


def _expected_sha256(
    connection: Connection, fleet: Services, robot: str, store_id: str, journal: str
) -> str:
    """Return the content that a journal has to have; empty for one that was not verified."""
    held = copies_of(connection, robot, store_id, journal)
    if not held:
        raise UsageError(f"the server has never had {journal}", "it is copied by itself")
    verified = next((one for one in held if one.state == "verified"), None)
    if verified is None:
        return ""
    if verified.raw_gone:
        raise UsageError(f"{journal} was deleted by retention", "its columns are kept longer")
    if is_sound(fleet.folder, verified):
        raise UsageError(f"the copy of {journal} is what the robot has signed")
    return str(verified.sha256)


def rotate(fleet: Services, who: Caller, robot: KnownRobot) -> CommandLine:
    """Let the recorder of a robot begin new files, so that the present ones can be copied."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        command = _order(connection, now_ns, robot.id, "rotate", JournalRotate(), who)
        details = {"command": command.id}
        who.note(connection, now_ns, "recordings.rotate", robot.id, details=details)
    _publish(fleet, robot.id, is_sent=True)
    return command_line(command)


def _order(
    connection: Connection, now_ns: int, robot: str, about: str, wanted: RecordCommand, who: Caller
) -> StoredCommand:
    """Order something now, or raise UsageError; return its command."""
    is_sent = record_orders.order(connection, now_ns, robot, about, wanted, str(who.principal))
    order = record_orders.find(connection, robot, about)
    found = None if order is None else commands.find(connection, now_ns, order.command)
    if not is_sent or found is None:
        raise UsageError(
            f"{robot} takes no such commands, or too many wait for it",
            "amberbox run on the robot takes them; look at its commands",
        )
    return found


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
