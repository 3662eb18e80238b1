"""Who is there: last seen, backlog, clock; and who is not any more."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from math import isfinite
from typing import get_args

from sqlalchemy import Connection, func, select, update

from amberbox.core.robotstatus import Monitoring
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.linkend.tables import BOOT, HEADS, ROBOT, ROW, STATUS
from amberbox.link.frames import Beat
from amberbox.monitoring.messages.pulse import Pulse


@dataclass(frozen=True, slots=True)
class Presence:
    """A robot as it was seen last; times by the server's clock."""

    robot: str
    connected: bool
    last_seen_ns: int
    connected_ns: int
    store_id: str
    boot_id: str
    config_hash: str
    version: str
    backlog: int
    backlog_bytes: int


def presences(connection: Connection) -> list[Presence]:
    """Return all robots that have ever connected, by name."""
    rows = connection.execute(select(ROBOT).order_by(ROBOT.c.robot))
    return [
        Presence(
            row.robot, row.connected, row.last_seen_ns, row.connected_ns, row.store_id,
            row.boot_id, row.config_hash, row.version, row.backlog, row.backlog_bytes,
        )
        for row in rows
    ]  # fmt: skip


def said_until(connection: Connection, robot: str) -> int | None:
    """Return when the newest of what a robot said over the link was written; None of nothing."""
    newest = (select(func.max(t.c.log_ns)).where(t.c.robot == robot) for t in (STATUS, ROW))
    times = [connection.execute(chosen).scalar() for chosen in newest]
    return max((time_ns for time_ns in times if time_ns is not None), default=None)


def seen(connection: Connection, robot: str, epoch: int, beat: Beat, boot: str, at_ns: int) -> None:
    """Note a heartbeat; one of an older epoch changes nothing."""
    mine = (ROBOT.c.robot == robot, ROBOT.c.epoch == epoch)
    values = {"last_seen_ns": at_ns, "backlog": beat.backlog, "backlog_bytes": beat.backlog_bytes}
    connection.execute(update(ROBOT).where(*mine).values(**values))
    if beat.offset_ns is not None and beat.round_ns is not None:
        row = {"robot": robot, "boot_id": boot, "offset_ns": beat.offset_ns,
               "round_ns": beat.round_ns, "at_ns": at_ns}  # fmt: skip
        change = ("offset_ns", "round_ns", "at_ns")
        connection.execute(upsert(connection.dialect, BOOT, ("robot", "boot_id"), change), [row])


def monitoring_said(beat: Beat) -> Pulse | None:
    """Return what a heartbeat says of the robot's watcher; None where it says nothing we know."""
    state = next((state for state in get_args(Monitoring) if state == beat.monitoring), None)
    if state is None:
        return None
    return Pulse(state, max(beat.delay_s, 0.0) if isfinite(beat.delay_s) else 0.0)


def gone(connection: Connection, robot: str, epoch: int, last_seen_ns: int) -> None:
    """Note that a connection has ended, unless the robot is there again already."""
    mine = (ROBOT.c.robot == robot, ROBOT.c.epoch == epoch)
    values = {"connected": False, "last_seen_ns": last_seen_ns}
    connection.execute(update(ROBOT).where(*mine).values(**values))


def nobody_connected(connection: Connection) -> None:
    """Begin anew after a restart of the server: no connection has survived it."""
    connection.execute(update(ROBOT).values(connected=False))


def keep_heads(connection: Connection, robot: str, store_id: str, heads: bytes, at_ns: int) -> None:
    """Keep a robot's statement of how far its record reaches."""
    digest = hashlib.sha256(heads).hexdigest()
    row = {"robot": robot, "store_id": store_id, "sha256": digest, "at_ns": at_ns, "heads": heads}
    key = ("robot", "store_id", "sha256")
    connection.execute(upsert(connection.dialect, HEADS, key, ()), [row])


def short(boot_id: str) -> str:
    """Return how the name of a journal's file tells its boot: what robots say of their runs."""
    return boot_id.replace("-", "")[:8]
