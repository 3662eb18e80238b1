"""Maintenance of the archive: commit journals, join and delete files, measure the disk."""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from sqlalchemy import Row, and_, func, select, update

from amberbox.blackbox.store.manifest_entries import Tombstone, from_record
from amberbox.blackbox.store.manifest_lines import decode
from amberbox.core.clock import NS, Clock
from amberbox.core.errors import AmberboxError
from amberbox.core.pacing import Backoff
from amberbox.link import ledger
from amberbox.link.frames import Hello
from amberbox.link.uploads import Proof
from amberbox.server import settings
from amberbox.server.archive.catalogue import COMMITTED, in_archive
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.retention import forget_old_rows
from amberbox.server.archive.worker import ArchiveWorker, WorkFailedError
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.ledger import drop_committed
from amberbox.server.ingest.link_state import log_event
from amberbox.server.ingest.uploads import IncomingJournal
from amberbox.server.journals import DELETED, LOST, JournalKey, MissingRows, Retention
from amberbox.server.schema import ASIDE, JOURNALS, UPLOAD

LOW_BYTES = 2 << 30
LOW_PART = 0.05
# Below this no uploads are accepted; robots keep their data
FULL_BYTES = 1 << 30

# Returns total, used and free bytes of the disk under a folder
Usage = Callable[[Path], tuple[int, int, int]]


@dataclass(frozen=True, slots=True)
class ServerDisk:
    """Size and free space of the disk under the data folder, in bytes."""

    total: int
    free: int

    @property
    def is_low(self) -> bool:
        """Return whether the disk is nearly full: below 2 GB, or below 5 %."""
        return self.free < LOW_BYTES or self.free < LOW_PART * self.total

    @property
    def is_full(self) -> bool:
        """Return whether no uploads can be accepted any more: below 1 GB."""
        return self.free < FULL_BYTES

    def __str__(self) -> str:
        return f"{self.free / (1 << 30):.1f} GB of {self.total / (1 << 30):.0f} GB are free"


def measure_disk(folder: Path, usage: Usage = shutil.disk_usage) -> ServerDisk:
    """Measure the disk under a folder."""
    total, _, free = usage(folder)
    return ServerDisk(total, free)


_SETTLED = "archive.settled"
# Journals whose rows are dropped in one transaction, so that other writers get a turn
_AT_ONCE = 20


@dataclass(frozen=True, slots=True)
class SettledBatch:
    """The last batch whose rows were dropped from the link's tables."""

    batch: int = 0


def drop_settled_rows(database: ServerDatabase, clock: Clock) -> list[str]:
    """Drop link rows that the archive holds by now; return the robots concerned. Idempotent."""
    robots: set[str] = set()
    while rows := _next(database):
        robots |= {row.robot for row in rows}
        for start in range(0, len(rows), _AT_ONCE):
            with database.begin() as connection:
                for row in rows[start : start + _AT_ONCE]:
                    drop_committed(connection, row.robot, row.store_id, row.writer, row.run,
                                   row.first_seq, row.end_seq)  # fmt: skip
        with database.begin() as connection:
            settings.write(connection, clock.wall_ns(), _SETTLED, SettledBatch(rows[0].batch))
    return sorted(robots)


def _next(database: ServerDatabase) -> Sequence[Row[Any]]:
    """Return the journals of the first batch that is committed and not settled."""
    with database.reading() as connection:
        settled = settings.read(connection, _SETTLED, SettledBatch).batch
        later = and_(JOURNALS.c.state == COMMITTED, JOURNALS.c.batch > settled)
        batch = connection.scalar(select(func.min(JOURNALS.c.batch)).where(later))
        if batch is None:
            return []
        return connection.execute(select(JOURNALS).where(later, JOURNALS.c.batch == batch)).all()


def take_over(archive: FolderArchive, database: ServerDatabase, folder: Path) -> int:
    """Put verified journals into the archive that it lacks; return how many it took.

    A server that died between both steps leaves such. Journals that are no longer valid are logged.
    """
    with database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(UPLOAD.c.state == "verified", ~in_archive()))
        found = [
            (JournalKey(row.robot, row.store_id, row.journal, row.sha256), folder / row.path)
            for row in rows
        ]
    return sum(_put(archive, key, path) for key, path in found if path.exists())


def take_confirmed(archive: FolderArchive, database: ServerDatabase, folder: Path) -> int:
    """Put journals into the archive whose signing key was confirmed since; return their number."""
    confirmed = and_(UPLOAD.c.state == "verified", UPLOAD.c.path.like("aside/%"))
    with database.reading() as connection:
        rows = connection.execute(select(UPLOAD).where(confirmed)).all()
    taken = 0
    for row in rows:
        key = JournalKey(row.robot, row.store_id, row.journal, row.sha256)
        path = archive.layout.journal(row.robot, row.store_id, row.journal)
        taken += (folder / row.path).exists() and _put(archive, key, folder / row.path)
        if path.exists():
            moved = {"path": path.relative_to(folder).as_posix()}
            mine = and_(UPLOAD.c.path == row.path, UPLOAD.c.sha256 == row.sha256)
            with database.begin() as connection:
                connection.execute(update(UPLOAD).where(mine).values(**moved))
    return taken


def _put(archive: FolderArchive, key: JournalKey, path: Path) -> bool:
    try:
        return archive.put(key, path).is_new
    except AmberboxError as error:
        logging.getLogger(__name__).warning("%s (%s)", error.what, error.hint)
    except Exception:  # accepted by an older server, refused by this one; the start must go on
        logging.getLogger(__name__).exception("%s of %s cannot be read", key.file, key.robot)
    return False


def note_lost(archive: FolderArchive, database: ServerDatabase) -> None:
    """Record in the archive the rows that robots lost at power cuts."""
    seq, at = ASIDE.c.seq, ASIDE.c.log_ns
    keys = (ASIDE.c.robot, ASIDE.c.store_id, ASIDE.c.writer, ASIDE.c.run)
    ends = (func.min(seq).label("first"), func.max(seq).label("last"),
            func.min(at).label("from_ns"), func.max(at).label("to_ns"))  # fmt: skip
    wanted = select(*keys, *ends).where(ASIDE.c.why == ledger.LOST).group_by(*keys)
    with database.reading() as connection:
        for row in connection.execute(wanted).all():
            one = MissingRows(
                row.writer, row.run, row.first, row.last + 1, row.from_ns, row.to_ns, LOST,
                "rows that came early are kept apart",
            )  # fmt: skip
            archive.note_missing(row.robot, row.store_id, [one])


def deleted_rows(proof: Proof) -> Iterator[MissingRows]:
    """Yield the rows that the robot deleted before any server had them, from a proof."""
    for line in f"{proof.lines}\n{proof.gone}".encode().split(b"\n"):
        if b',"kind":"gone",' not in line:
            continue
        record = decode(line)
        try:
            found = from_record(record) if record is not None else None
        except (msgspec.ValidationError, KeyError, TypeError):
            continue
        if isinstance(found, Tombstone) and found.what != "columns" and not found.confirmed:
            yield MissingRows(
                found.writer, found.run, found.first_seq, found.end_seq, found.start_ns,
                found.end_ns, DELETED, found.reason[:500],
            )  # fmt: skip


T = TypeVar("T")

_RETAINED = "archive.retained"
# A day less a minute: an hourly check is never exact to the second
_DAY_NS = 24 * 3600 * NS - 60 * NS

# Name of the setting: a list of rules; without any everything is kept
RETENTION = "retention"
COMMIT_S = 60.0
# How long a first journal waits for others, as robots come home together
_GATHER_S = 1.0
_HOUR_S = 3600.0
# Seconds from the start of the server to its first maintenance
_FIRST_S = 600.0
_DISK_S = 10.0


@dataclass(frozen=True, slots=True)
class LastRetention:
    """When old data were last deleted."""

    at_ns: int = 0


class ArchiveMaintenance:
    """Commits journals as they arrive, joins files, and deletes old data."""

    def __init__(
        self,
        folder: Path,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        archive: FolderArchive,
        *,
        every_s: float = COMMIT_S,
        usage: Usage = shutil.disk_usage,
    ) -> None:
        self._folder = folder
        self._database = database
        self._bus = bus
        self._clock = clock
        self._archive = archive
        self._ages = archive.ages
        self._every_s = every_s
        self._usage = usage
        self._worker = ArchiveWorker(folder)
        self._thread = ThreadPoolExecutor(1, "archive")  # one request at a time
        self._woken = asyncio.Event()
        self._room = measure_disk(folder, usage)
        self._disk_state = "disk_ok"
        self._trouble = ""
        bus.on("journal", lambda _: self._woken.set())
        bus.on("robot", lambda _: self._woken.set())  # its signing key may have been confirmed
        bus.on("connected", self._on_connected)
        bus.on("gone", lambda change: self._ages.forget(change.robot))

    @property
    def is_full(self) -> bool:
        """Return whether the disk has no room for uploads."""
        return self._room.is_full

    @property
    def room(self) -> ServerDisk:
        """The free space at the last measurement."""
        return self._room

    def troubles(self) -> list[str]:
        """Return the problems of the archive and its disk."""
        low = f"the disk is nearly full: {self._room}" if self._room.is_low else ""
        return [text for text in (low, self._trouble, self._ages.read().text) if text]

    def note_deleted(self, incoming: IncomingJournal, proof: Proof) -> None:
        """Record in the archive the data that the robot deleted before they were copied."""
        missing = list(deleted_rows(proof))
        if missing:
            self._archive.note_missing(incoming.robot, incoming.store_id, missing)

    async def run(self) -> None:
        """Work until cancelled."""
        await self._look_at_disk()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._commit_always())
            group.create_task(self._tidy_always())
            group.create_task(self._watch_disk())

    def close(self) -> None:
        """End the worker; unfinished work continues after the next start."""
        self._worker.close()
        self._thread.shutdown(cancel_futures=True)

    def _on_connected(self, change: ServerChange) -> None:
        hello = change.data.get("hello")
        if isinstance(hello, Hello):
            self._ages.compare_wall(change.robot, hello.wall_ns)
        if getattr(change.data.get("admission"), "conflicts", ()):
            self._woken.set()

    async def _in_thread(self, work: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)

    async def _commit_always(self) -> None:
        backoff = Backoff(least_s=1.0, most_s=60.0)
        await self._in_thread(partial(take_over, self._archive, self._database, self._folder))
        await self._in_thread(self._archive.try_again)
        while True:
            self._woken.clear()
            try:
                wait_s = await self._commit_once()
            except WorkFailedError as error:
                await self._in_thread(
                    partial(self._archive.note_failure, error.journal, error.what)
                )
                self._failed(error)
                wait_s = backoff.failed()
            except AmberboxError as error:
                self._failed(error)
                wait_s = backoff.failed()
            else:
                self._trouble = ""
                backoff.succeeded()
            if wait_s is not None:
                await asyncio.sleep(max(wait_s, 0.05))
                continue
            await self._woken.wait()
            await asyncio.sleep(min(_GATHER_S, self._every_s))

    async def _commit_once(self) -> float | None:
        """Commit the waiting journals if due; return seconds until the next commit, None if nothing
        waits.
        """
        archive, database = self._archive, self._database
        await self._in_thread(partial(take_confirmed, archive, database, self._folder))
        await self._in_thread(partial(note_lost, archive, database))
        self._publish(
            await self._in_thread(partial(drop_settled_rows, self._database, self._clock))
        )
        if not await self._in_thread(self._has_work):
            return None
        done = await self._in_thread(partial(self._worker.commit, self._every_s))
        self._publish(
            await self._in_thread(partial(drop_settled_rows, self._database, self._clock))
        )
        return done.next_in_s if done.waiting else None

    def _has_work(self) -> bool:
        """Return whether journals wait, so that no worker is started without need."""
        catalogue = self._archive.catalogue
        return catalogue.open_batch() is not None or bool(catalogue.waiting())

    def _publish(self, robots: list[str]) -> None:
        if robots:
            self._bus.publish(ServerChange("committed", data={"robots": robots}))

    async def _tidy_always(self) -> None:
        """Join and sweep every hour, delete old data once a day."""
        await asyncio.sleep(_FIRST_S)
        while True:
            try:
                await self._in_thread(self._tidy_once)
            except AmberboxError as error:
                self._failed(error)
            await asyncio.sleep(_HOUR_S)

    def _tidy_once(self) -> None:
        """Run one maintenance; the time of the last deletion is stored, for servers restarted
        daily.
        """
        now_ns = self._clock.wall_ns()
        with self._database.reading() as connection:
            since_ns = now_ns - settings.read(connection, _RETAINED, LastRetention).at_ns
        is_daily = not 0 <= since_ns < _DAY_NS
        self.tidy(is_daily=is_daily)
        if is_daily:
            with self._database.begin() as connection:
                settings.write(connection, now_ns, _RETAINED, LastRetention(now_ns))

    def tidy(self, *, is_daily: bool) -> None:
        """Maintain the archive once; blocks. Raises AmberboxError when the worker fails."""
        with self._database.reading() as connection:
            rules = settings.read(connection, RETENTION, tuple[Retention, ...])
        now_ns = self._ages.look().age_ns
        if is_daily:
            forget_old_rows(self._database, rules, now_ns)
        if not self._archive.catalogue.revision():
            return
        if is_daily:
            self._worker.retain(now_ns, *rules)
        self._worker.compact()
        self._worker.sweep()

    def _failed(self, error: AmberboxError) -> None:
        journal = getattr(error, "journal", "")
        what = error.what.removeprefix("the archive: ")
        self._trouble = f"the archive: {what}" + (f" (journal {journal})" if journal else "")
        logging.getLogger(__name__).warning("%s (%s)", self._trouble, error.hint)

    async def _watch_disk(self) -> None:
        while True:
            await asyncio.sleep(_DISK_S)
            await self._look_at_disk()

    async def _look_at_disk(self) -> None:
        """Measure the disk; log a change of its state as an event."""
        self._room = await asyncio.to_thread(measure_disk, self._folder, self._usage)
        with suppress(AmberboxError):  # the database is busy: retried at the next measurement
            await asyncio.to_thread(self._ages.look)
        room = self._room
        state = "disk_full" if room.is_full else "disk_low" if room.is_low else "disk_ok"
        if state != self._disk_state:
            self._disk_state = state
            await asyncio.to_thread(self._note_disk, state)

    def _note_disk(self, state: str) -> None:
        text = _TEXTS[state].format(self._room)
        with self._database.begin() as connection:
            log_event(connection, "", self._clock.wall_ns(), state, text)


_TEXTS = {
    "disk_ok": "the server's disk has room again: {}",
    "disk_low": "the server's disk is nearly full: {}",
    "disk_full": "the server's disk is full, journals stay on the robots: {}",
}
