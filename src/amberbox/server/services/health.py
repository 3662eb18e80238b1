"""Health and metrics of the server itself: what is wrong with it, and figures in Prometheus' text
format.
"""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from sqlalchemy import Connection, func, select

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.timestamps import format_time
from amberbox.core.types import Status
from amberbox.server import system
from amberbox.server.accounts.robots import list_robots
from amberbox.server.alarms.recipients import LOST_HINT, NAME, Notifications
from amberbox.server.archive.catalogue import COMMITTED, PUT
from amberbox.server.archive.commit import KIND
from amberbox.server.archive.retention import ClockComparison
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import FILE
from amberbox.server.ingest.link_state import pending_keys
from amberbox.server.live.links import NEW_NS, damaged_files
from amberbox.server.live.status import counts
from amberbox.server.schema import ASIDE, EVENT, JOURNALS, ROBOT, ROBOTS
from amberbox.server.services.context import Services
from amberbox.server.settings import read
from amberbox.server.system import WatchedFolder

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"


@dataclass(frozen=True, slots=True)
class MetricSample:
    """One number; ``suffix`` is added to the family's name (``_bucket``)."""

    value: float
    labels: Mapping[str, str] = field(default_factory=dict)
    suffix: str = ""


@dataclass(frozen=True, slots=True)
class MetricFamily:
    """Samples of one name, in base units (seconds, bytes)."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    about: str
    samples: Sequence[MetricSample]


def gauge(name: str, about: str, value: float | None) -> MetricFamily:
    """Return a gauge without labels; without a value there is no sample."""
    return MetricFamily(name, "gauge", about, () if value is None else (MetricSample(value),))


def counter(name: str, about: str, value: float) -> MetricFamily:
    """Return a counter without labels."""
    return MetricFamily(name, "counter", about, (MetricSample(value),))


def metrics_text(families: Iterable[MetricFamily]) -> str:
    """Write families as text."""
    lines = []
    for family in families:
        lines.append(f"# HELP {family.name} {_escaped(family.about)}")
        lines.append(f"# TYPE {family.name} {family.kind}")
        lines += [
            f"{family.name}{s.suffix}{_labels(s.labels)} {_number(s.value)}" for s in family.samples
        ]
    return "\n".join(lines) + "\n"


def _labels(labels: Mapping[str, str]) -> str:
    if not labels:
        return ""
    pairs = (f'{name}="{_escaped(text, quote=True)}"' for name, text in labels.items())
    return "{" + ",".join(pairs) + "}"


def _escaped(text: str, *, quote: bool = False) -> str:
    escaped = text.replace("\\", "\\\\").replace("\n", "\\n")
    return escaped.replace('"', '\\"') if quote else escaped


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(float(value))


_PAGE = os.sysconf("SC_PAGE_SIZE")


class ReceivedCounter:
    """Counts rows and journals received from robots, by the events of the bus."""

    def __init__(self, bus: EventBus) -> None:
        self.rows = self.bytes = self.journals = 0
        bus.on("rows", self._rows)
        bus.on("journal", self._journal)

    def _rows(self, change: ServerChange) -> None:
        self.rows += len(change.data["rows"])
        self.bytes += sum(len(row.data) for row in change.data["rows"])

    def _journal(self, _: ServerChange) -> None:
        self.journals += 1


def families(services: Services, received: ReceivedCounter) -> Iterator[MetricFamily]:
    """Give all figures but those of requests."""
    yield from _robots(services)
    yield from _levels(services)
    yield from _arrivals(received)
    yield from _archive(services)
    yield from _damaged(services)
    yield from _disk(services.folder)
    yield from _feed(services)
    yield from process()


def _robots(services: Services) -> Iterator[MetricFamily]:
    links = services.links.robots
    with services.database.reading() as connection:
        known = connection.scalar(select(func.count()).select_from(ROBOTS)) or 0
        backlog = connection.scalar(select(func.sum(ROBOT.c.backlog_bytes))) or 0
        offline = connection.scalar(select(func.sum(ROBOT.c.backlog)).where(~ROBOT.c.connected))
        aside = connection.scalar(select(func.count()).select_from(ASIDE)) or 0
    online = list(links.values())
    yield gauge("amberbox_robots", "Robots that are known.", known)
    yield gauge("amberbox_robots_online", "Robots that are connected.", len(online))
    rows = sum(one.backlog for one in online) + int(offline or 0)
    yield gauge("amberbox_backlog_rows", "Rows that robots have and did not send yet.", rows)
    yield gauge("amberbox_backlog_bytes", "The same in bytes, as robots said last.", int(backlog))
    yield gauge("amberbox_rows_aside", "Rows that robots have no more.", aside)
    waiting = sum(one.answers.qsize() for one in online)
    yield gauge("amberbox_link_queue", "Frames of robots that are not answered yet.", waiting)
    about = "Frames of robots that were ignored: this version does not know them."
    yield counter("amberbox_link_unknown_frames_total", about, services.links.unknown_frames)


def _levels(services: Services) -> Iterator[MetricFamily]:
    with services.database.reading() as connection:
        statuses = services.feed.state.statuses
        known = statuses.of(connection, list_robots(connection), services.clock.wall_ns())
    about = "Robots by the level of their status; unknown: nothing is known of now."
    levels = [
        MetricSample(count, {"level": level}) for level, count in sorted(counts(known).items())
    ]
    yield MetricFamily("amberbox_robots_by_level", "gauge", about, levels)


def _arrivals(received: ReceivedCounter) -> Iterator[MetricFamily]:
    yield counter("amberbox_rows_received_total", "Rows received over links.", received.rows)
    about = "Bytes of rows received over links."
    yield counter("amberbox_row_bytes_received_total", about, received.bytes)
    about = "Journals received, whatever became of them."
    yield counter("amberbox_journals_received_total", about, received.journals)


def _archive(services: Services) -> Iterator[MetricFamily]:
    counted = select(JOURNALS.c.state, func.count(), func.sum(JOURNALS.c.bytes))
    with services.database.reading() as connection:
        rows = connection.execute(counted.group_by(JOURNALS.c.state)).all()
    states = [state for state, _, _ in rows]
    known = {state: (int(count), int(size or 0)) for state, count, size in rows}
    for state in (COMMITTED, PUT, *states):
        known.setdefault(state, (0, 0))
    about = "Journals by state; put: their columns are to come."
    counts = [MetricSample(count, {"state": state}) for state, (count, _) in sorted(known.items())]
    yield MetricFamily("amberbox_archive_journals", "gauge", about, counts)
    sizes = [MetricSample(size, {"state": state}) for state, (_, size) in sorted(known.items())]
    yield MetricFamily("amberbox_archive_journal_bytes", "gauge", "Their bytes.", sizes)


def _damaged(services: Services) -> Iterator[MetricFamily]:
    with services.database.reading() as connection:
        found = damaged_files(connection, services.clock.wall_ns()).values()
    about = "Journals that were damaged when they came, and are set aside."
    yield gauge("amberbox_files_damaged", about, sum(one.count for one in found))


def _disk(folder: Path) -> Iterator[MetricFamily]:
    paths = (folder / FILE, folder / f"{FILE}-wal")
    size = sum(path.stat().st_size for path in paths if path.exists())
    yield gauge("amberbox_database_bytes", "Size of the database with its log.", size)
    usage = shutil.disk_usage(folder)
    yield gauge("amberbox_disk_free_bytes", "Free on the disk of the data folder.", usage.free)
    yield gauge("amberbox_disk_bytes", "Size of the disk of the data folder.", usage.total)


def _feed(services: Services) -> Iterator[MetricFamily]:
    feed = services.feed
    yield gauge("amberbox_feed_subscribers", "Sockets that hear of changes.", len(feed.listeners))
    yield counter("amberbox_feed_changes_total", "Changes told since the start.", feed.told)


def process() -> Iterator[MetricFamily]:
    """Give what this process takes."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = used.ru_utime + used.ru_stime
    yield counter("process_cpu_seconds_total", "Processor time of the server.", round(cpu_s, 3))
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    yield gauge("process_resident_memory_bytes", "Memory of the server.", pages * _PAGE)
    files = sum(1 for _ in Path("/proc/self/fd").iterdir())
    yield gauge("process_open_fds", "Files and connections that are open.", files)


_SHOWN = 5


def find_troubles(services: Services) -> list[str]:
    """Return the problems of the server that need attention soon, as sentences."""
    with services.database.reading() as connection:
        now_ns = services.clock.wall_ns()
        damaged = damaged_files(connection, now_ns)
        refused = _refused(connection, now_ns - NEW_NS)
        notified = read(connection, NAME, Notifications)
        waiting = pending_keys(connection)
    lately = {robot: one.new for robot, one in damaged.items() if one.new}
    files = sum(lately.values())
    what = "1 file was" if files == 1 else f"{files} files were"
    whose = ", ".join(sorted(lately))
    said = [f"{what} damaged and set aside in the last 24 hours, of {whose}"] if files else []
    if notified.has_lost_secrets:
        said.append(f"secrets of notifications cannot be read: {LOST_HINT}")
    said += [
        f"{key.robot} signs with another key than before, which waits for an admin: /admin/robots"
        for key in waiting
    ]
    return [*services.keeping.troubles(), *said, *refused]


def _refused(connection: Connection, since_ns: int) -> list[str]:
    """Say of which journals no rows could be made lately: robot, file and what to do."""
    chosen = select(EVENT.c.robot, EVENT.c.text).where(EVENT.c.kind == KIND)
    newest = chosen.where(EVENT.c.at_ns >= since_ns).order_by(EVENT.c.at_ns.desc()).limit(_SHOWN)
    return [f"{row.robot}: {row.text}" for row in connection.execute(newest)]


@dataclass(frozen=True, slots=True)
class Health:
    """Whether the server answers; ``poor``: it does, and needs somebody soon."""

    status: Literal["ok", "poor", "bad"]


@dataclass(frozen=True, slots=True)
class ServerClock:
    """The server's clock beside the confirmed time, by which recordings grow old.

    ``jump``: ``ahead`` or ``behind``, nothing is deleted because of ``by_s`` until it is confirmed;
    empty where both agree. ``text`` says so.
    """

    time: str
    confirmed: str
    jump: Literal["", "ahead", "behind"]
    by_s: float
    text: str


@dataclass(frozen=True, slots=True)
class FileProblem:
    """What is wrong in a file of a folder."""

    file: str
    line: int
    where: str
    what: str
    hint: str
    is_error: bool


@dataclass(frozen=True, slots=True)
class SystemComponent:
    """How a component of a team or of the system is; with ``mode`` one monitor of it."""

    component: str
    mode: str
    level: str
    state: str
    reason: str
    blocked_by: list[str]
    measured: str
    since: str


@dataclass(frozen=True, slots=True)
class SystemFolder:
    """A team, or the system: whether it is watched, and what its watcher says."""

    name: str
    state: str
    restarts: int
    trouble: str
    members: list[str]
    problems: list[FileProblem]
    statuses: list[SystemComponent]


def _folder(watched: WatchedFolder) -> SystemFolder:
    place = watched.place
    problems = [
        FileProblem(_inside(p.file, str(place.path)), p.line, p.where, p.what, p.hint, p.is_error)
        for p in place.problems
    ]
    return SystemFolder(
        place.name, "refused" if place.store is None else watched.state, watched.restarts,
        watched.trouble.replace(f"{place.path}/", ""), sorted(place.members), problems,
        [_component(status) for status in system.statuses(place.store)],
    )  # fmt: skip


def _inside(file: str, folder: str) -> str:
    return file.removeprefix(folder).lstrip("/")


def _component(status: Status) -> SystemComponent:
    return SystemComponent(
        status.component, status.mode, status.level, status.state, status.reason,
        list(status.blocked_by), format_time(status.measured_ns), format_time(status.since_ns),
    )  # fmt: skip


def read_health(fleet: Services) -> Health:
    """Return whether the server and its database answer, and whether they need attention."""
    try:
        with fleet.database.reading() as connection:
            connection.execute(select(1))
    except AmberboxError:
        return Health("bad")
    return Health("poor" if find_troubles(fleet) else "ok")


def server_clock(found: ClockComparison) -> ServerClock:
    """Return the clock as it is shown."""
    return ServerClock(
        format_time(found.wall_ns), format_time(found.age_ns), found.jump,
        found.ahead_ns / NS if found.jump else 0.0, found.text,
    )  # fmt: skip


def read_system(fleet: Services) -> list[SystemFolder]:
    """Return how teams and the system are, teams first; nothing if none is set up."""
    return [_folder(watched) for watched in fleet.system.watched()]
