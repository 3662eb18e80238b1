"""What the server measures of itself."""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import func, select

from amberbox.fleet.accounts.robots import list_robots
from amberbox.fleet.accounts.tables import ROBOTS
from amberbox.fleet.archive.catalogue import COMMITTED, PUT
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import FILE
from amberbox.fleet.linkend.tables import ASIDE, ROBOT
from amberbox.fleet.metrics.text import Family, Sample, counter, gauge
from amberbox.fleet.services import Services
from amberbox.fleet.services.status import counts
from amberbox.fleet.state.damaged import damaged_files

_PAGE = os.sysconf("SC_PAGE_SIZE")


class Received:
    """Counts what comes from robots, as the bus tells of it."""

    def __init__(self, bus: Bus) -> None:
        self.rows = self.bytes = self.journals = 0
        bus.on("rows", self._rows)
        bus.on("journal", self._journal)

    def _rows(self, change: Change) -> None:
        self.rows += len(change.data["rows"])
        self.bytes += sum(len(row.data) for row in change.data["rows"])

    def _journal(self, _: Change) -> None:
        self.journals += 1


def families(services: Services, received: Received) -> Iterator[Family]:
    """Give all figures but those of requests."""
    yield from _robots(services)
    yield from _levels(services)
    yield from _arrivals(received)
    yield from _archive(services)
    yield from _damaged(services)
    yield from _disk(services.folder)
    yield from _feed(services)
    yield from process()


def _robots(services: Services) -> Iterator[Family]:
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


def _levels(services: Services) -> Iterator[Family]:
    with services.database.reading() as connection:
        statuses = services.feed.state.statuses
        known = statuses.of(connection, list_robots(connection), services.clock.wall_ns())
    about = "Robots by the level of their status; unknown: nothing is known of now."
    levels = [Sample(count, {"level": level}) for level, count in sorted(counts(known).items())]
    yield Family("amberbox_robots_by_level", "gauge", about, levels)


def _arrivals(received: Received) -> Iterator[Family]:
    yield counter("amberbox_rows_received_total", "Rows received over links.", received.rows)
    about = "Bytes of rows received over links."
    yield counter("amberbox_row_bytes_received_total", about, received.bytes)
    about = "Journals received, whatever became of them."
    yield counter("amberbox_journals_received_total", about, received.journals)


def _archive(services: Services) -> Iterator[Family]:
    counted = select(JOURNALS.c.state, func.count(), func.sum(JOURNALS.c.bytes))
    with services.database.reading() as connection:
        rows = connection.execute(counted.group_by(JOURNALS.c.state)).all()
    states = [state for state, _, _ in rows]
    known = {state: (int(count), int(size or 0)) for state, count, size in rows}
    for state in (COMMITTED, PUT, *states):
        known.setdefault(state, (0, 0))
    about = "Journals by state; put: their columns are to come."
    counts = [Sample(count, {"state": state}) for state, (count, _) in sorted(known.items())]
    yield Family("amberbox_archive_journals", "gauge", about, counts)
    sizes = [Sample(size, {"state": state}) for state, (_, size) in sorted(known.items())]
    yield Family("amberbox_archive_journal_bytes", "gauge", "Their bytes.", sizes)


def _damaged(services: Services) -> Iterator[Family]:
    with services.database.reading() as connection:
        found = damaged_files(connection, services.clock.wall_ns()).values()
    about = "Journals that were damaged when they came, and are set aside."
    yield gauge("amberbox_files_damaged", about, sum(one.count for one in found))


def _disk(folder: Path) -> Iterator[Family]:
    paths = (folder / FILE, folder / f"{FILE}-wal")
    size = sum(path.stat().st_size for path in paths if path.exists())
    yield gauge("amberbox_database_bytes", "Size of the database with its log.", size)
    usage = shutil.disk_usage(folder)
    yield gauge("amberbox_disk_free_bytes", "Free on the disk of the data folder.", usage.free)
    yield gauge("amberbox_disk_bytes", "Size of the disk of the data folder.", usage.total)


def _feed(services: Services) -> Iterator[Family]:
    feed = services.feed
    yield gauge("amberbox_feed_subscribers", "Sockets that hear of changes.", len(feed.listeners))
    yield counter("amberbox_feed_changes_total", "Changes told since the start.", feed.told)


def process() -> Iterator[Family]:
    """Give what this process takes."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = used.ru_utime + used.ru_stime
    yield counter("process_cpu_seconds_total", "Processor time of the server.", round(cpu_s, 3))
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    yield gauge("process_resident_memory_bytes", "Memory of the server.", pages * _PAGE)
    files = sum(1 for _ in Path("/proc/self/fd").iterdir())
    yield gauge("process_open_fds", "Files and connections that are open.", files)
