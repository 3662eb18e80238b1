"""What is known of a robot's link: its stores, clocks, signed heads, and what was noticed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from amberbox.core.clock import NS
from amberbox.fleet.linkend.tables import ASIDE, BOOT, EVENT, HEADS, STORE, WRITER
from amberbox.fleet.state.said import moment

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
    """Return the stores of a robot, the first one first."""
    cursors: dict[str, dict[str, tuple[int, int]]] = {}
    for row in connection.execute(select(WRITER).where(WRITER.c.robot == robot)):
        cursors.setdefault(row.store_id, {})[row.writer] = (row.run, row.seq)
    rows = connection.execute(
        select(STORE).where(STORE.c.robot == robot).order_by(STORE.c.first_seen_ns)
    )
    return [
        Store(
            row.store_id, moment(row.first_seen_ns), row.public_key, cursors.get(row.store_id, {})
        )
        for row in rows
    ]


def clocks(connection: Connection, robot: str) -> list[BootClock]:
    """Return the clocks of a robot's newest boots, the newest first."""
    wanted = select(BOOT).where(BOOT.c.robot == robot).order_by(BOOT.c.at_ns.desc())
    return [
        BootClock(
            row.boot_id, round(row.offset_ns / NS, 6), round(row.round_ns / NS, 6),
            moment(row.at_ns),
        )
        for row in connection.execute(wanted.limit(_BOOTS))
    ]  # fmt: skip


def heads(connection: Connection, robot: str) -> list[SignedHead]:
    """Return the newest statements of a robot, the newest first."""
    wanted = select(HEADS).where(HEADS.c.robot == robot).order_by(HEADS.c.at_ns.desc())
    return [
        SignedHead(row.store_id, row.sha256, moment(row.at_ns), row.heads.decode(errors="replace"))
        for row in connection.execute(wanted.limit(_HEADS))
    ]


def aside(connection: Connection, robot: str) -> dict[str, int]:
    """Count the rows that the robot has no more."""
    counted = select(ASIDE.c.why, func.count()).where(ASIDE.c.robot == robot)
    rows = connection.execute(counted.group_by(ASIDE.c.why)).all()
    return {row[0]: row[1] for row in rows}


def events(connection: Connection, robot: str, after: int, limit: int) -> list[LinkEvent]:
    """Return what was noticed behind a number, oldest first; without one the newest."""
    wanted = select(EVENT).where(EVENT.c.robot == robot)
    if after:
        wanted = wanted.where(EVENT.c.number > after).order_by(EVENT.c.number)
    else:
        wanted = wanted.order_by(EVENT.c.number.desc())
    rows = connection.execute(wanted.limit(limit)).all()
    return [
        LinkEvent(row.number, moment(row.at_ns), row.kind, row.text)
        for row in sorted(rows, key=lambda row: int(row.number))
    ]
