"""The context of a request: the parts of the running server, the caller, and the times of
a query.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Connection

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.timestamps import parse_time
from amberbox.server.accounts.passwords import Passwords
from amberbox.server.accounts.permissions import Principal, RobotGroups, allowed
from amberbox.server.accounts.robots import KnownRobot, list_robots
from amberbox.server.accounts.signin import SignInCodes
from amberbox.server.alarms.manager import Alarms
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.maintenance import ArchiveMaintenance
from amberbox.server.audit import AuditEntry, Result, append
from amberbox.server.bus import EventBus
from amberbox.server.config import ServerSettings
from amberbox.server.data.downloads import DownloadService
from amberbox.server.database import ServerDatabase
from amberbox.server.experiments.judge import RunJudge
from amberbox.server.experiments.robot_runs import RobotRuns
from amberbox.server.experiments.runner import ExperimentRunner
from amberbox.server.ingest.fetches import FetchService
from amberbox.server.ingest.folders import FolderService
from amberbox.server.ingest.link_server import LinkServer, SessionRevocation
from amberbox.server.ingest.uploads import UploadService
from amberbox.server.knowledge.explanations import Explained
from amberbox.server.learning.following import FollowService
from amberbox.server.learning.models import LearningService
from amberbox.server.live.feed import Feed
from amberbox.server.record_orders import RecordOrders
from amberbox.server.system import SystemLevel
from amberbox.server.workers.pool import RequestThreads, WorkerPool


class NotFoundError(AmberboxError):
    """A thing that does not exist, or that the caller may not see: 404, with the same text for
    both.
    """


class NotNowError(AmberboxError):
    """A robot that is away, or does not allow this as it is now: 409."""


class Demonstration(Protocol):
    """Simulated robots, and what can be broken in them; threads may share it."""

    @property
    def codes(self) -> SignInCodes:
        """Return the codes that sign people in."""

    @property
    def robots(self) -> Sequence[str]:
        """Return the ids of the robots."""

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults that are offered, by their names in the simulator's catalogue."""

    def broken(self) -> Mapping[str, str]:
        """Return the present fault of each broken robot; healthy ones are not in it."""

    def damage(self, robot: str, fault: str) -> None:
        """Inject a fault into a robot, instead of its present one; raises UsageError for unknown
        ones.
        """

    def repair(self, robot: str) -> None:
        """Let a robot be well again; raises UsageError for an unknown one."""

    def codes_at_robots(self) -> Mapping[str, str]:
        """Return the code that is shown at each robot where a motion waits for confirmation."""

    def confirm(self, robot: str) -> None:
        """Confirm the motion that waits at a robot, as somebody there; raises UsageError if none
        does.
        """

    def end(self) -> None:
        """Handle the coming end of the server: robots may end as well."""


@dataclass(slots=True, eq=False)
class Services:
    """The parts of the server by their task; ``assembly.py`` puts them together."""

    folder: Path
    settings: ServerSettings
    clock: Clock
    database: ServerDatabase
    passwords: Passwords
    bus: EventBus
    archive: FolderArchive
    links: LinkServer
    upload_service: UploadService
    folders: FolderService
    worker_pool: WorkerPool
    """Workers for the requests of people and programs."""
    robot_worker_pool: WorkerPool
    """Unpacks and reads data of robots, and explains diagnoses in advance."""
    explained: Explained
    jobs: DownloadService
    learning: LearningService
    following: FollowService
    fetches: FetchService
    alarms: Alarms
    record_orders: RecordOrders
    feed: Feed
    runner: ExperimentRunner
    judge: RunJudge
    robot_runs: RobotRuns
    system: SystemLevel
    keeping: ArchiveMaintenance
    revocation: SessionRevocation
    threads: RequestThreads
    demo: Demonstration | None = None
    """Set where the server is part of a demonstration: ``amberbox demo``, and nothing else."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The caller of a request; ``session_id`` and ``secret`` if a session's cookie was sent."""

    principal: Principal
    address: str
    agent: str = ""
    session_id: str = ""
    secret: str = field(default="", repr=False)

    @property
    def person(self) -> str:
        """Return the id of the person who calls, with whichever of their tokens."""
        return self.principal.owner or self.principal.id

    def may(self, action: str, robot: KnownRobot | RobotGroups | None = None) -> bool:
        """Return whether an action is allowed, to a robot or to all of them; robots: to itself."""
        seen = robot.robot if isinstance(robot, KnownRobot) else robot
        if seen is None and self.principal.kind == "robot":
            seen = RobotGroups(self.principal.id)
        return allowed(self.principal, action, seen)

    def may_some(self, action: str) -> bool:
        """Return whether the caller may do an action for robots of their groups, if there
        are any.
        """
        groups = self.principal.groups
        if groups is None:
            return self.may(action)
        return bool(groups) and self.may(action, RobotGroups("", groups))

    def robots(self, connection: Connection, action: str = "status.read") -> list[KnownRobot]:
        """Return the robots to which an action is allowed, disabled ones too."""
        return [robot for robot in list_robots(connection) if self.may(action, robot)]

    def note(
        self, connection: Connection, now_ns: int, action: str, object: str = "",
        result: Result = "ok", details: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Add to the audit log, in the transaction of the change."""
        entry = AuditEntry(str(self.principal), self.address, action, object, result, details or {})
        append(connection, now_ns, entry)


def query_time_ns(text: str, clock: Clock) -> int | None:
    """Read a time of a query, None for an empty one; raises UsageError."""
    return parse_time(text, clock.wall_ns, clock.wall_ns) if text.strip() else None


def robot_time_ns(services: Services, robot: str, text: str) -> int | None:
    """Read a time, None for an empty one; ``-10m`` counts from the robot's last record."""
    if not text.strip():
        return None
    return parse_time(
        text, services.clock.wall_ns, lambda: services.archive.catalogue.last_ns([robot])
    )


def robot_span_ns(
    services: Services, robot: str, from_: str, to: str
) -> tuple[int | None, int | None]:
    """Read a range; raises UsageError for one that ends before it begins."""
    from_ns, to_ns = (robot_time_ns(services, robot, text) for text in (from_, to))
    if from_ns is not None and to_ns is not None and from_ns >= to_ns:
        raise UsageError("the range ends before it begins", "exchange from and to")
    return from_ns, to_ns
