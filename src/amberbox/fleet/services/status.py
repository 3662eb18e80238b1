"""The one status of each robot on the server: what API, pages, feed and metrics ask.

It is made of what is known here of the robot's link, watcher, components, alarms and diagnosis;
``core.robotstatus`` judges it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection

from amberbox.core.robotstatus import (
    NOT_MONITORED,
    Contact,
    Observed,
    RobotStatus,
    components_level,
    judge,
)
from amberbox.core.types import Level
from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.linkend.presence import Presence, presences
from amberbox.fleet.linkend.server import Connected, LinkServer
from amberbox.fleet.state.latest import Latest, Recent
from amberbox.fleet.state.openalarms import OpenAlarms, open_alarms
from amberbox.fleet.state.said import SaidStatus
from amberbox.fleet.state.standing import (
    Moment,
    Standing,
    clock_offsets_ns,
    monitoring_of,
    silence,
    standings,
)

FEW = 50
"""Of so many robots the statuses are looked up by name; of more, all are read."""


@dataclass(frozen=True, slots=True)
class Known:
    """The status of a robot with what it was made of.

    ``silence`` says why nothing counts now, empty where something does. ``gone_ns`` is since when
    nothing of what the open diagnosis explains is seen any more (robot's clock).
    """

    robot: KnownRobot
    status: RobotStatus
    silence: str
    presence: Presence | None
    link: Connected | None
    statuses: Sequence[Standing]
    when: Moment
    alarms: OpenAlarms
    recent: Recent
    gone_ns: int | None


@dataclass(frozen=True, slots=True)
class RobotStatuses:
    """Judges robots, in one look at the database."""

    links: LinkServer
    latest: Latest

    def of(
        self,
        connection: Connection,
        robots: Sequence[KnownRobot],
        now_ns: int,
        statuses: Mapping[str, Sequence[Standing]] | None = None,
    ) -> list[Known]:
        """Return how robots are, in their order; ``statuses`` where they have been read already."""
        names = [robot.id for robot in robots]
        if statuses is None:
            statuses = standings(connection, names if len(names) <= FEW else None)
        seen = {presence.robot: presence for presence in presences(connection)}
        alarms, offsets = open_alarms(connection), clock_offsets_ns(connection)
        return [
            self._known(
                robot, seen.get(robot.id), statuses.get(robot.id, ()),
                Moment(now_ns, offsets.get(robot.id)), alarms.get(robot.id, OpenAlarms()),
            )
            for robot in robots
        ]  # fmt: skip

    def _known(
        self,
        robot: KnownRobot,
        presence: Presence | None,
        statuses: Sequence[Standing],
        when: Moment,
        alarms: OpenAlarms,
    ) -> Known:
        link, recent = self.links.robots.get(robot.id), self.latest.of(robot.id)
        contact = _contact(presence, link)
        pulse = link.monitoring if link is not None else None
        monitoring = monitoring_of(statuses, when, pulse)
        delay_s = pulse.delay_s if pulse is not None else 0.0
        gone_ns = recent.gone_ns(when.now_ns - (when.offset_ns or 0))
        is_diagnosed = recent.diagnosis is not None and gone_ns is None
        status = judge(
            Observed(
                contact, monitoring, level_of(statuses), cause_of(worst_of(statuses)),
                alarms.lasting, alarms.reason, is_diagnosed,
                recent.effect if is_diagnosed else "", _as_of(statuses, when),
                delay_s,
            )
        )  # fmt: skip
        why = silence(contact, presence, monitoring, statuses, when, delay_s)
        return Known(robot, status, why, presence, link, statuses, when, alarms, recent, gone_ns)


def level_of(statuses: Sequence[Standing]) -> Level:
    """Return the worst level of the components; a word that is no level is ``unknown``."""
    return components_level(
        (one.said.known_level, one.said.state) for one in statuses if not one.said.mode
    )


def worst_of(statuses: Sequence[Standing]) -> SaidStatus | None:
    """Return what is worst; of those that are equally bad one that is not blocked by another."""
    components = (
        one.said for one in statuses if not one.said.mode and one.said.state != NOT_MONITORED
    )
    return max(components, key=lambda said: (said.rank, not said.blocked_by), default=None)


def cause_of(bad: SaidStatus | None) -> str:
    """Say what is wrong with a component as "component: reason"; empty for one that is well."""
    if bad is None or bad.level == "ok":
        return ""
    what = bad.reason or bad.state.replace("_", " ") or bad.level
    blocked = f" (blocked by {', '.join(bad.blocked_by)})" if bad.blocked_by else ""
    return f"{bad.component}: {what}{blocked}"


def counts(known: Sequence[Known]) -> Mapping[Level, int]:
    """Count robots by their level, the worst first; also the levels that none has."""
    levels: tuple[Level, ...] = ("error", "stale", "unknown", "warn", "ok")
    return {level: sum(one.status.level == level for one in known) for level in levels}


def _contact(presence: Presence | None, link: Connected | None) -> Contact:
    if link is not None:
        return "silent" if link.is_silent else "online"
    return "offline" if presence is not None else "never"


def _as_of(statuses: Sequence[Standing], when: Moment) -> str | None:
    newest_ns = max((one.said.measured_ns for one in statuses), default=0)
    return when.at(newest_ns)
