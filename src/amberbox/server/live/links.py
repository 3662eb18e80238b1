"""State of a robot's link and files: stores, clocks, signed heads, events, damaged files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from sqlalchemy import Connection, Select, case, func, select, union_all

from amberbox.core.clock import NS
from amberbox.server.archive.catalogue import REFUSED, in_archive
from amberbox.server.live.records import format_moment
from amberbox.server.schema import ASIDE, BOOT, EVENT, HEADS, JOURNALS, STORE, UPLOAD, WRITER

_HEADS = 20
_BOOTS = 50


@dataclass(frozen=True, slots=True)
class Store:
    """A store of a robot; ``cursor`` is run and number up to which each writer is held for good."""

    store_id: str
    first_seen: str | None
    public_key: str
    cursor: dict[str, tuple[int, int]]


@dataclass(frozen=True, slots=True)
class BootClock:
    """How far the server's clock was ahead in a boot; ``round_s`` bounds the error."""

    boot_id: str
    offset_s: float
    round_s: float
    at: str | None


@dataclass(frozen=True, slots=True)
class SignedHead:
    """A robot's signed statement of how far its record reached, as it came."""

    store_id: str
    sha256: str
    at: str | None
    heads: str


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """Something that was noticed; ``number`` is for ``after``."""

    number: int
    at: str | None
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Link:
    """A robot's link. ``aside`` counts rows that are kept apart, by reason."""

    robot: str
    online: bool
    connected_since: str | None
    last_seen: str | None
    store_id: str
    boot_id: str
    config_hash: str
    version: str
    backlog_rows: int
    backlog_bytes: int
    stores: Sequence[Store]
    clocks: Sequence[BootClock]
    heads: Sequence[SignedHead]
    aside: dict[str, int]
    events: Sequence[LinkEvent]


def stores(connection: Connection, robot: str) -> list[Store]:
    """Return the stores of a robot, the oldest first."""
    cursors: dict[str, dict[str, tuple[int, int]]] = {}
    for row in connection.execute(select(WRITER).where(WRITER.c.robot == robot)):
        cursors.setdefault(row.store_id, {})[row.writer] = (row.run, row.seq)
    rows = connection.execute(
        select(STORE).where(STORE.c.robot == robot).order_by(STORE.c.first_seen_ns)
    )
    return [
        Store(
            row.store_id,
            format_moment(row.first_seen_ns),
            row.public_key,
            cursors.get(row.store_id, {}),
        )
        for row in rows
    ]


def clocks(connection: Connection, robot: str) -> list[BootClock]:
    """Return the clock offsets of a robot's newest boots, newest first."""
    wanted = select(BOOT).where(BOOT.c.robot == robot).order_by(BOOT.c.at_ns.desc())
    return [
        BootClock(
            row.boot_id, round(row.offset_ns / NS, 6), round(row.round_ns / NS, 6),
            format_moment(row.at_ns),
        )
        for row in connection.execute(wanted.limit(_BOOTS))
    ]  # fmt: skip


def heads(connection: Connection, robot: str) -> list[SignedHead]:
    """Return the newest signed heads of a robot, newest first."""
    wanted = select(HEADS).where(HEADS.c.robot == robot).order_by(HEADS.c.at_ns.desc())
    return [
        SignedHead(
            row.store_id, row.sha256, format_moment(row.at_ns), row.heads.decode(errors="replace")
        )
        for row in connection.execute(wanted.limit(_HEADS))
    ]


def aside(connection: Connection, robot: str) -> dict[str, int]:
    """Return the number of rows that the robot no longer has, by reason."""
    counted = select(ASIDE.c.why, func.count()).where(ASIDE.c.robot == robot)
    rows = connection.execute(counted.group_by(ASIDE.c.why)).all()
    return {row[0]: row[1] for row in rows}


def events(connection: Connection, robot: str, after: int, limit: int) -> list[LinkEvent]:
    """Return events after a number, oldest first; without a number the newest."""
    wanted = select(EVENT).where(EVENT.c.robot == robot)
    if after:
        wanted = wanted.where(EVENT.c.number > after).order_by(EVENT.c.number)
    else:
        wanted = wanted.order_by(EVENT.c.number.desc())
    rows = connection.execute(wanted.limit(limit)).all()
    return [
        LinkEvent(row.number, format_moment(row.at_ns), row.kind, row.text)
        for row in sorted(rows, key=lambda row: int(row.number))
    ]


# How long a damaged file counts as new
NEW_NS: Final = 24 * 3600 * NS


@dataclass(frozen=True, slots=True)
class DamagedFiles:
    """Number of files of a robot that are set aside as damaged; ``new`` of them arrived
    recently.
    """

    count: int = 0
    new: int = 0


def damaged_files(connection: Connection, now_ns: int) -> Mapping[str, DamagedFiles]:
    """Return the damaged files by robot; files that later arrived intact are left out."""
    found = union_all(_refused_at_once(), _refused_later()).subquery()
    is_new = case((found.c.at_ns >= now_ns - NEW_NS, 1), else_=0)
    counted = select(found.c.robot, func.count(), func.sum(is_new)).group_by(found.c.robot)
    rows = connection.execute(counted)
    return {robot: DamagedFiles(int(count), int(new)) for robot, count, new in rows}


def _refused_at_once() -> Select[tuple[str, int]]:
    """Select files that arrived damaged; several damaged copies count once."""
    u = UPLOAD.c
    of = (u.robot, u.store_id, u.journal)
    chosen = select(u.robot, func.max(u.ended_ns).label("at_ns"))
    return chosen.where(u.state == "quarantined", ~in_archive()).group_by(*of)


def _refused_later() -> Select[tuple[str, int]]:
    """Select files that changed on the server before their rows were read."""
    return select(JOURNALS.c.robot, JOURNALS.c.put_ns).where(JOURNALS.c.state == REFUSED)
