"""Robots at a glance: who is there, what is worst and why, what it is doing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection

from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.linkend.presence import Presence, presences
from amberbox.fleet.linkend.server import LinkServer
from amberbox.fleet.linkend.signingkeys import KeyState, distrusted_stores
from amberbox.fleet.state.damaged import Damaged, damaged_files
from amberbox.fleet.state.facts import FactsBook
from amberbox.fleet.state.latest import Latest, Recent
from amberbox.fleet.state.openalarms import OpenAlarms, open_alarms
from amberbox.fleet.state.said import SaidStatus, moment
from amberbox.fleet.state.standing import (
    Moment,
    Standing,
    clock_offsets_ns,
    silence,
    standings,
)
from amberbox.fleet.state.views import Battery, Card, Lead, OnMission

_CHARGES = ("percent", "charge", "soc", "state_of_charge", "level")
"""Parts of the name of an output that says how full a battery is, the best first."""
FEW = 50
"""Of so many robots the statuses are looked up by name; of more, all are read."""


@dataclass(frozen=True, slots=True)
class Cards:
    """Makes cards of robots, in one look at the database."""

    links: LinkServer
    latest: Latest
    facts: FactsBook

    def of(
        self,
        connection: Connection,
        robots: Sequence[KnownRobot],
        now_ns: int,
        statuses: Mapping[str, Sequence[Standing]] | None = None,
    ) -> list[Card]:
        """Return the cards of robots; ``statuses`` where they have been read already."""
        if statuses is None:
            names = [robot.id for robot in robots]
            statuses = standings(connection, names if len(names) <= FEW else None)
        seen = {presence.robot: presence for presence in presences(connection)}
        alarms, offsets = open_alarms(connection), clock_offsets_ns(connection)
        damaged, distrusted = damaged_files(connection, now_ns), distrusted_stores(connection)
        return [
            self._card(
                robot, seen.get(robot.id), statuses.get(robot.id, []),
                Moment(now_ns, offsets.get(robot.id)),
                alarms.get(robot.id, OpenAlarms()), damaged.get(robot.id, Damaged()), distrusted,
            )
            for robot in robots
        ]  # fmt: skip

    def _card(
        self,
        robot: KnownRobot,
        presence: Presence | None,
        statuses: Sequence[Standing],
        when: Moment,
        alarms: OpenAlarms,
        damaged: Damaged,
        distrusted: Mapping[tuple[str, str], KeyState],
    ) -> Card:
        link = self.links.robots.get(robot.id)
        online = link is not None
        monitoring = link.monitoring if link is not None else None
        silent = silence(presence, online, statuses, when, monitoring)
        components = [status.said for status in statuses if not status.said.mode]
        worst = _worst(components)
        last_level = worst.level if worst else "unknown"
        recent = self.latest.of(robot.id)
        config_hash = presence.config_hash if presence else ""
        facts = self.facts.known(robot.id, config_hash)
        last_seen = link.last_seen_ns if link else presence.last_seen_ns if presence else None
        return Card(
            robot.id, sorted(robot.groups), facts.model if facts else "",
            robot.disabled_ns is not None, online, moment(last_seen),
            moment(presence.connected_ns) if presence and online else None,
            link.backlog if link else presence.backlog if presence else 0,
            presence.backlog_bytes if presence else 0, presence.version if presence else "",
            config_hash, "unknown" if silent else last_level, last_level, alarms.severity,
            silent or _cause(worst), dict(Counter(status.level for status in components)),
            alarms.count,
            _battery(statuses), _mission(recent), _lead(recent),
            link is not None and link.is_silent, alarms.over,
            damaged.count, damaged.new,
            _distrust(distrusted.get((robot.id, presence.store_id)) if presence else None),
            monitoring.state if monitoring else "", monitoring.delay_s if monitoring else 0.0,
        )  # fmt: skip


def _distrust(state: KeyState | None) -> Literal["", "pending", "refused"]:
    return "" if state is None or state == "confirmed" else state


def _worst(components: Sequence[SaidStatus]) -> SaidStatus | None:
    """Return what is worst; of those that are equally bad one that is not blocked by another."""
    return max(components, key=lambda s: (s.rank, not s.blocked_by), default=None)


def _cause(worst: SaidStatus | None) -> str:
    if worst is None or worst.level == "ok":
        return ""
    what = worst.reason or worst.state.replace("_", " ") or worst.level
    blocked = f" (blocked by {', '.join(worst.blocked_by)})" if worst.blocked_by else ""
    return f"{worst.component}: {what}{blocked}"


def _battery(statuses: Sequence[Standing]) -> Battery | None:
    """Find how full the battery is: a number of a component that is called so."""
    outputs = [
        output
        for status in statuses
        if "battery" in status.said.component.casefold()
        for output in status.said.outputs
        if output.value is not None and output.type in ("int", "float")
    ]
    for word in _CHARGES:
        for output in outputs:
            if word in output.name.casefold() and output.value is not None:
                return Battery(output.name, output.value)
    return None


def _mission(recent: Recent) -> OnMission | None:
    found = recent.mission
    return None if found is None else OnMission(found.id, found.name, moment(found.from_ns))


def _lead(recent: Recent) -> Lead | None:
    found = recent.diagnosis
    if found is None:
        return None
    first = found.hypotheses[0]
    return Lead(found.id, first.faults, first.probability, moment(found.at_ns))
