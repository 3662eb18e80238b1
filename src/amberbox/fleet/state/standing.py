"""The status board of robots as it counts now: what is stale or of nothing any more is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, and_, select

from amberbox.core.clock import NS
from amberbox.core.robotstatus import Contact, Monitoring
from amberbox.fleet.linkend.presence import Presence
from amberbox.fleet.linkend.tables import BOOT, ROBOT, STATUS
from amberbox.fleet.state.said import SaidStatus, heard, moment
from amberbox.monitoring.messages.board import duration, overloaded
from amberbox.monitoring.messages.pulse import Pulse

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


@dataclass(frozen=True, slots=True)
class Moment:
    """Now by the server's clock, and how far that is ahead of the robot's, if it is known."""

    now_ns: int
    offset_ns: int | None

    def age_ns(self, status: Standing) -> int:
        """Return how old a measurement is.

        Differences of one clock each: since it came, from its writing to its coming, and on the
        robot. Only the way over the link compares two clocks, by their offset.
        """
        since_ns = max(self.now_ns - status.received_ns, 0)
        robot_ns = max(status.log_ns - status.said.measured_ns, 0) if status.said.measured_ns else 0
        way_ns = 0
        if self.offset_ns is not None:
            way_ns = max(status.received_ns - status.log_ns - self.offset_ns, 0)
        return since_ns + way_ns + robot_ns

    def at(self, robot_ns: int) -> str | None:
        """Write a time of the robot by the server's clock."""
        return moment(robot_ns + (self.offset_ns or 0)) if robot_ns else None


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


def clock_offsets_ns(connection: Connection, robots: Sequence[str] | None = None) -> dict[str, int]:
    """Return how far the server's clock is ahead of robots' in their present boots."""
    same = and_(BOOT.c.robot == ROBOT.c.robot, BOOT.c.boot_id == ROBOT.c.boot_id)
    wanted = select(BOOT.c.robot, BOOT.c.offset_ns).join(ROBOT, same)
    if robots is not None:
        wanted = wanted.where(BOOT.c.robot.in_(robots))
    return {row.robot: row.offset_ns for row in connection.execute(wanted)}


def monitoring_of(
    statuses: Sequence[Standing], when: Moment, pulse: Pulse | None = None
) -> Monitoring:
    """Tell whether a robot's watcher says anything that is about now.

    ``pulse`` is what the link says of it, apart from the statuses: one that is late is not silent.
    """
    if not statuses:
        return "absent"
    if pulse is not None and pulse.state == "overloaded":
        return "overloaded"
    return "running" if _newest_ns(statuses, when) <= SILENT_NS else "silent"


def silence(
    contact: Contact,
    presence: Presence | None,
    monitoring: Monitoring,
    statuses: Sequence[Standing],
    when: Moment,
    delay_s: float = 0.0,
) -> str:
    """Say why nothing is known of a robot now; empty where something is.

    ``delay_s`` is how late overloaded monitoring evaluates.
    """
    if contact == "never" or presence is None:
        return "it has never connected"
    if contact != "online":
        seen = duration(when.now_ns - presence.last_seen_ns)
        return f"{'offline' if contact == 'offline' else 'silent'}, last seen {seen} ago"
    if monitoring == "absent":
        return "it has said nothing of its components yet"
    if monitoring == "overloaded":
        return overloaded(delay_s)
    if monitoring != "silent":
        return ""
    unheard_ns = when.now_ns - max(status.received_ns for status in statuses)
    if unheard_ns > SILENT_NS:
        return f"its watcher has said nothing for {duration(unheard_ns)}"
    return f"what it says is {duration(_newest_ns(statuses, when))} old"


def _newest_ns(statuses: Sequence[Standing], when: Moment) -> int:
    """Return how long ago anything was said, or how old it was then if that is more."""
    unheard_ns = when.now_ns - max(status.received_ns for status in statuses)
    return max(unheard_ns, min(when.age_ns(status) for status in statuses))
