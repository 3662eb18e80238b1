"""Robots at a glance: who is there, what is worst and why, what it is doing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection

from amberbox.fleet.accounts.robots import KnownRobot
from amberbox.fleet.linkend.signingkeys import KeyState, distrusted_stores
from amberbox.fleet.services.status import Known, RobotStatuses
from amberbox.fleet.state.damaged import Damaged, damaged_files
from amberbox.fleet.state.facts import FactsBook
from amberbox.fleet.state.latest import Recent
from amberbox.fleet.state.said import SaidHypothesis, moment
from amberbox.fleet.state.standing import Standing
from amberbox.fleet.state.views import Battery, Card, Lead, OnMission

_CHARGES = ("percent", "charge", "soc", "state_of_charge", "level")
"""Parts of the name of an output that says how full a battery is, the best first."""


@dataclass(frozen=True, slots=True)
class Cards:
    """Makes cards of robots, in one look at the database."""

    statuses: RobotStatuses
    facts: FactsBook

    def of(
        self,
        connection: Connection,
        robots: Sequence[KnownRobot],
        now_ns: int,
        statuses: Mapping[str, Sequence[Standing]] | None = None,
    ) -> list[Card]:
        """Return the cards of robots; ``statuses`` where they have been read already."""
        damaged, distrusted = damaged_files(connection, now_ns), distrusted_stores(connection)
        return [
            self._card(known, damaged.get(known.robot.id, Damaged()), distrusted)
            for known in self.statuses.of(connection, robots, now_ns, statuses)
        ]

    def _card(
        self, known: Known, damaged: Damaged, distrusted: Mapping[tuple[str, str], KeyState]
    ) -> Card:
        robot, presence, link, status = known.robot, known.presence, known.link, known.status
        pulse = link.monitoring if link is not None else None
        config_hash = presence.config_hash if presence else ""
        facts = self.facts.known(robot.id, config_hash)
        last_seen = link.last_seen_ns if link else presence.last_seen_ns if presence else None
        levels = Counter(one.said.level for one in known.statuses if not one.said.mode)
        return Card(
            robot.id, sorted(robot.groups), facts.model if facts else "",
            robot.disabled_ns is not None, link is not None, moment(last_seen),
            moment(presence.connected_ns) if presence and link else None,
            link.backlog if link else presence.backlog if presence else 0,
            presence.backlog_bytes if presence else 0, presence.version if presence else "",
            config_hash, status.level, status.last_level, known.alarms.severity,
            known.silence or status.reason, dict(levels), known.alarms.count,
            _battery(known.statuses), _mission(known.recent), _lead(known.recent), status,
            link is not None and link.is_silent, known.alarms.over, damaged.count, damaged.new,
            _distrust(distrusted.get((robot.id, presence.store_id)) if presence else None),
            pulse.state if pulse else "", pulse.delay_s if pulse else 0.0,
        )  # fmt: skip


def _distrust(state: KeyState | None) -> Literal["", "pending", "refused"]:
    return "" if state is None or state == "confirmed" else state


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
    first = found.hypotheses[0] if found.hypotheses else SaidHypothesis()
    return Lead(found.id, first.faults, first.probability, moment(found.at_ns))
