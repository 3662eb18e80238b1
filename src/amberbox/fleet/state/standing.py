"""The status board of robots as it counts now: what is stale or of nothing any more is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, select

from amberbox.core.clock import NS
from amberbox.fleet.linkend.presence import Presence
from amberbox.fleet.linkend.tables import BOOT, STATUS
from amberbox.fleet.state.said import SaidStatus, heard
from amberbox.monitoring.messages.board import duration

SILENT_NS = 10 * NS
"""The watcher says everything each second; over a bad network that may come a little later."""
_ROUND_NS = 5 * NS
"""A status this much older than the newest is of something that is watched no more."""


@dataclass(frozen=True, slots=True)
class Standing:
    """A status, and when it was written (robot's clock) and came (server's clock)."""

    said: SaidStatus
    log_ns: int
    received_ns: int


def standings(
    connection: Connection, robots: Sequence[str] | None = None
) -> dict[str, list[Standing]]:
    """Return the newest statuses by robot, of all robots or of some, in the order of names."""
    wanted = select(STATUS).order_by(*STATUS.primary_key.columns)
    if robots is not None:
        wanted = wanted.where(STATUS.c.robot.in_(robots))
    found: dict[str, list[Standing]] = {}
    for row in connection.execute(wanted):
        said = heard(row.data, SaidStatus)
        if said is not None:
            one = Standing(said, row.log_ns, row.received_ns)
            found.setdefault(row.robot, []).append(one)
    return {robot: _watched(statuses) for robot, statuses in found.items()}


def _watched(statuses: Sequence[Standing]) -> list[Standing]:
    newest_ns = max(status.log_ns for status in statuses)
    return [status for status in statuses if status.log_ns >= newest_ns - _ROUND_NS]


def clock_offset_ns(connection: Connection, robot: str, boot_id: str) -> int | None:
    """Return how far the server's clock is ahead of the robot's in a boot."""
    wanted = select(BOOT.c.offset_ns).where(BOOT.c.robot == robot, BOOT.c.boot_id == boot_id)
    return connection.execute(wanted).scalar()


def silence(
    presence: Presence | None, online: bool, statuses: Sequence[Standing], now_ns: int
) -> str:
    """Say why nothing is known of a robot now; empty where something is."""
    if presence is None:
        return "it has never connected"
    if not online:
        return f"offline, last seen {duration(now_ns - presence.last_seen_ns)} ago"
    if not statuses:
        return "it has said nothing of its components yet"
    newest_ns = max(status.received_ns for status in statuses)
    if now_ns - newest_ns > SILENT_NS:
        return f"its watcher has said nothing for {duration(now_ns - newest_ns)}"
    return ""
