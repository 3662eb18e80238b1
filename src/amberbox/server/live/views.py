"""Robots in the form of API and feed: cards, the component tree, and the state they are built from.

Times are RFC 3339.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Connection, select

from amberbox.core.api import (
    Battery,
    Card,
    Component,
    Condition,
    Lead,
    Mode,
    Need,
    OnMission,
    Output,
    StatusTree,
)
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.server.accounts.robots import KnownRobot, list_robots
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.folders import FolderService
from amberbox.server.ingest.link_server import LinkServer
from amberbox.server.ingest.link_state import KeyState, distrusted_stores
from amberbox.server.live.facts import ComponentFacts, FactsCache, FolderFacts, OutputFacts
from amberbox.server.live.links import DamagedFiles, damaged_files
from amberbox.server.live.records import (
    HypothesisRecord,
    OutputRecord,
    RetainedStatus,
    ServerNow,
    clock_offsets_ns,
    format_moment,
    retained_statuses,
    status_data,
)
from amberbox.server.live.status import (
    FEW,
    AssessedRobot,
    LatestRecords,
    RecentRecords,
    RobotStatuses,
)
from amberbox.server.schema import ROBOTS
from amberbox.server.workers.pool import WorkerPool

_NOTHING = OutputFacts("")


def status_tree(known: AssessedRobot, facts: FolderFacts) -> StatusTree:
    """Return the tree of declared components with statuses; undeclared ones are at the end."""
    by_name: dict[str, list[RetainedStatus]] = {}
    for status in known.statuses:
        by_name.setdefault(status.record.component, []).append(status)
    planned = {component.id for component in facts.components}
    extra = [ComponentFacts(name, name) for name in by_name if name not in planned]
    levels = {(s.record.component, s.record.mode): s.record.level for s in known.statuses}
    components = [
        _component(one, by_name.get(one.id, ()), levels, known.when)
        for one in (*facts.components, *extra)
    ]
    offset_ns = known.when.offset_ns
    offset_s = None if offset_ns is None else round(offset_ns / NS, 6)
    return StatusTree(
        known.robot.id, known.link is not None, known.silence, facts.note, offset_s, components,
        known.status,
    )  # fmt: skip


def _component(
    facts: ComponentFacts,
    statuses: Sequence[RetainedStatus],
    levels: Mapping[tuple[str, str], str],
    when: ServerNow,
) -> Component:
    own = next((status for status in statuses if not status.record.mode), None)
    needs = [
        Need(need.name, need.component, levels.get((need.component, need.mode), "unknown"))
        for need in facts.needs
    ]
    return Component(
        facts.id, facts.name, facts.depth, facts.description, facts.part_of, needs, facts.rule,
        facts.recovery_actions, None if own is None else _condition(own, when),
        [_mode(status, facts, when) for status in statuses if status.record.mode],
    )  # fmt: skip


def _condition(status: RetainedStatus, when: ServerNow) -> Condition:
    record = status.record
    for_s = max(record.measured_ns - record.since_ns, 0) / NS if record.since_ns else 0.0
    return Condition(
        record.level, record.state, record.reason, record.blocked_by, when.at(record.measured_ns),
        when.at(record.since_ns), round(when.age_ns(status) / NS, 3), round(for_s, 3),
    )  # fmt: skip


def _mode(status: RetainedStatus, facts: ComponentFacts, when: ServerNow) -> Mode:
    mode = status.record.mode
    planned = {output.name: output for output in facts.outputs.get(mode, ())}
    outputs = [
        _output(record, planned.get(record.name, _NOTHING)) for record in status.record.outputs
    ]
    return Mode(mode, facts.names.get(mode, mode), _condition(status, when), outputs)


def _output(output: OutputRecord, facts: OutputFacts) -> Output:
    return Output(
        output.name,
        output.type,
        output.shown,
        facts.expected,
        facts.severity,
        facts.description,
        facts.unit,
    )


# Parts of the names of outputs for a battery's charge, the best first
_CHARGES = ("percent", "charge", "soc", "state_of_charge", "level")


@dataclass(frozen=True, slots=True)
class CardBuilder:
    """Builds cards of robots, in one transaction of the database."""

    statuses: RobotStatuses
    facts: FactsCache

    def of(
        self,
        connection: Connection,
        robots: Sequence[KnownRobot],
        now_ns: int,
        statuses: Mapping[str, Sequence[RetainedStatus]] | None = None,
    ) -> list[Card]:
        """Return the cards of robots; ``statuses`` if they were read already."""
        damaged, distrusted = damaged_files(connection, now_ns), distrusted_stores(connection)
        return [
            self._card(known, damaged.get(known.robot.id, DamagedFiles()), distrusted)
            for known in self.statuses.of(connection, robots, now_ns, statuses)
        ]

    def _card(
        self,
        known: AssessedRobot,
        damaged: DamagedFiles,
        distrusted: Mapping[tuple[str, str], KeyState],
    ) -> Card:
        robot, presence, link, status = known.robot, known.presence, known.link, known.status
        pulse = link.monitoring if link is not None else None
        config_hash = presence.config_hash if presence else ""
        facts = self.facts.known(robot.id, config_hash)
        last_seen = link.last_seen_ns if link else presence.last_seen_ns if presence else None
        levels = Counter(one.record.level for one in known.statuses if not one.record.mode)
        return Card(
            robot.id, sorted(robot.groups), facts.model if facts else "",
            robot.disabled_ns is not None, link is not None, format_moment(last_seen),
            format_moment(presence.connected_ns) if presence and link else None,
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


def _battery(statuses: Sequence[RetainedStatus]) -> Battery | None:
    """Return the charge of a battery: an output of a component with that name, or None."""
    outputs = [
        output
        for status in statuses
        if "battery" in status.record.component.casefold()
        for output in status.record.outputs
        if output.value is not None and output.type in ("int", "float")
    ]
    for word in _CHARGES:
        for output in outputs:
            if word in output.name.casefold() and output.value is not None:
                return Battery(output.name, output.value)
    return None


def _mission(recent: RecentRecords) -> OnMission | None:
    found = recent.mission
    return None if found is None else OnMission(found.id, found.name, format_moment(found.from_ns))


def _lead(recent: RecentRecords) -> Lead | None:
    found = recent.diagnosis
    if found is None:
        return None
    first = found.hypotheses[0] if found.hypotheses else HypothesisRecord()
    return Lead(found.id, first.faults, first.probability, format_moment(found.at_ns))


@dataclass(frozen=True, slots=True)
class FleetSnapshot:
    """How robots are at one moment."""

    robots: Sequence[Card]
    statuses: Mapping[str, Sequence[Mapping[str, Any]]]


class FleetState:
    """Newest missions, diagnoses and folder facts of all robots; threads may share it."""

    def __init__(
        self,
        database: ServerDatabase,
        archive: FolderArchive,
        bus: EventBus,
        links: LinkServer,
        folders: FolderService,
        worker_pool: WorkerPool,
    ) -> None:
        self.database = database
        self.archive = archive
        self.latest = LatestRecords()
        self.facts = FactsCache(folders, worker_pool)
        self.statuses = RobotStatuses(links, self.latest)
        self.cards = CardBuilder(self.statuses, self.facts)
        self._bus = bus
        bus.on("explained", self._explained)
        self._folders = folders
        self._wanted: asyncio.Queue[str] = asyncio.Queue()

    async def run(self) -> None:
        """Load the past of all robots, then of new ones, one after the other."""
        ends: list[Callable[[], None]] = [
            self._bus.on("rows", self._rows),
            self._bus.on("connected", self._robot),
            self._bus.on("robot", self._robot),
        ]
        try:
            for robot in await asyncio.to_thread(self._robots):
                self._wanted.put_nowait(robot)
            while True:
                robot = await self._wanted.get()
                await asyncio.to_thread(self._load, robot)
        finally:
            for end in ends:
                end()

    def snapshot(
        self, robots: Collection[str], now_ns: int, *, with_statuses: bool
    ) -> FleetSnapshot:
        """Return cards of robots, and their statuses."""
        with self.database.reading() as connection:
            known = [robot for robot in list_robots(connection) if robot.id in robots]
            few = sorted(robots) if len(robots) <= FEW else None
            found = retained_statuses(connection, few)
            cards = self.cards.of(connection, known, now_ns, found)
            offsets = clock_offsets_ns(connection, few)
        when = {robot: ServerNow(now_ns, offsets.get(robot)) for robot in robots}
        statuses = {
            robot: [
                {**status_data(one.record), "age_s": round(when[robot].age_ns(one) / NS, 2)}
                for one in found[robot]
            ]
            for robot in sorted(robots if with_statuses else ())
            if robot in found
        }
        return FleetSnapshot(cards, statuses)

    def _rows(self, change: ServerChange) -> None:
        self.latest.take(change.robot, change.data["rows"])

    def _explained(self, change: ServerChange) -> None:
        """Store the severity of an explained diagnosis' effect."""
        answer = change.data["answer"]
        explanation = answer.get("explanation")
        if explanation and answer.get("id"):
            severity = explanation["use"]["severity"]
            self.latest.explain(change.robot, answer["id"], answer["revision"], severity)

    def _robot(self, change: ServerChange) -> None:
        if change.robot:
            self._wanted.put_nowait(change.robot)

    def _robots(self) -> list[str]:
        with self.database.reading() as connection:
            return list(connection.execute(select(ROBOTS.c.robot)).scalars())

    def _load(self, robot: str) -> None:
        try:
            self.latest.load(self, robot)
            self.facts.read(robot, self._folders.current(robot))
        except AmberboxError as error:  # its card is incomplete; others are not affected
            logging.getLogger(__name__).warning("%s: %s", robot, error)
        except Exception:  # of a robot whose files are damaged, the same
            logging.getLogger(__name__).exception("the past of %s cannot be read", robot)
