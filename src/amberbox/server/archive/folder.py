"""The archive in a local folder: journals as files, their columns as Delta tables."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import cast

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import sync_folder
from amberbox.server.archive import commit as archive_commit
from amberbox.server.archive import retention
from amberbox.server.archive.catalogue import PUT, REFUSED, ArchiveCatalogue, RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.record import ArchiveRecord
from amberbox.server.archive.retention import RetentionClock
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.journals import (
    CommitResult,
    JournalKey,
    MissingRows,
    PutResult,
    Retention,
    checked_key,
    inspect,
)


class FolderArchive:
    """The archive of recorded data, below a server's data folder.

    ``commit``, ``compact``, ``retain`` and ``sweep`` are for one process at a time: the worker. All
    other methods may run in several processes at once.
    """

    def __init__(
        self, folder: Path, database: ServerDatabase | None = None, clock: Clock | None = None
    ) -> None:
        self.layout = ArchiveLayout(folder)
        self.clock = clock or SystemClock()
        self.layout.tables.mkdir(parents=True, exist_ok=True)
        self.layout.journals.mkdir(exist_ok=True)
        self.catalogue = ArchiveCatalogue(database or ServerDatabase(folder / FILE, self.clock))
        self.ages = RetentionClock(self.catalogue.database, self.clock)

    def put(self, key: JournalKey, path: Path, *, is_checked: bool = False) -> PutResult:
        """Move a verified journal file to its place; an existing one is not changed.

        With ``is_checked`` its hash and its chain have just been verified. Raises AmberboxError for
        an invalid file, or one that differs from the stored file of this name; the file is then not
        moved.
        """
        checked_key(key)
        place = self.layout.journal(key.robot, key.store_id, key.file)
        known = self.catalogue.find(key)
        if known is not None:
            if known.sha256 != key.sha256:
                raise AmberboxError(
                    f"{key.file} of {key.robot} is here already, with other content",
                    "a sealed journal never changes: compare both before you delete one",
                )
            if known.state != REFUSED:
                return PutResult(False, place)
        arrived = inspect(key, path, self.ages.came_ns(), is_checked=is_checked)
        _move(path, place)
        if known is not None:  # replaces a file that was altered on the server by the robot's
            self.catalogue.change([known], state=PUT, facts=arrived.row["facts"])
            return PutResult(True, place)
        return PutResult(self.catalogue.add(arrived.row), place)

    def note_missing(self, robot: str, store_id: str, ranges: Sequence[MissingRows]) -> None:
        """Store ranges of rows that will never arrive; idempotent."""
        self.catalogue.note_missing(RobotStore(robot, store_id), ranges)

    def commit(self, every_s: float = 60.0) -> CommitResult:
        """Finish an interrupted batch first, then convert waiting journals into table rows."""
        steps = self.commit_steps(every_s)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                return cast("CommitResult", end.value)

    def commit_steps(self, every_s: float = 60.0) -> archive_commit.Steps:
        """Commit step by step; yields the journal at hand."""
        now_ns = self.clock.wall_ns()
        return archive_commit.commit(self.layout, self.catalogue, now_ns, every_s)

    def note_failure(self, journal: str, why: str) -> None:
        """Count that a commit failed over a journal (``robot/store_id/file``, empty: unknown)."""
        archive_commit.note_failure(self.catalogue, self.clock.wall_ns(), journal, why)

    def try_again(self) -> int:
        """Requeue journals that another version of the server refused; return their number."""
        return archive_commit.try_again(self.catalogue, self.clock.wall_ns())

    def compact(self) -> int:
        """Join small files of the tables; return how many files were replaced."""
        return archive_commit.compact(self.layout, self.catalogue)

    def retain(self, rules: Sequence[Retention], now_ns: int | None = None) -> int:
        """Delete data that are older than the rules allow; return the number of journals concerned.

        ``now_ns`` is the time from which ages count; the server gives it to the worker, since only
        the server compares its clock with the robots'.
        """
        now_ns = self.ages.read().age_ns if now_ns is None else now_ns
        return retention.retain(self.layout, self.catalogue, rules, now_ns)

    def sweep(self) -> int:
        """Delete files that nothing refers to; return how many. Readers retry."""
        removed = 0
        for path in list(archive_commit.leftovers(self.layout, self.catalogue.schemas())):
            with suppress(FileNotFoundError):
                path.unlink()
                removed += 1
        return removed + retention.remove_journals(self.layout, self.catalogue)

    def robot(self, *robots: str) -> ArchiveRecord:
        """Open the record of some robots for queries; of all without a name."""
        return ArchiveRecord(self.layout.folder, robots=robots, catalogue=self.catalogue)


def _move(path: Path, place: Path) -> None:
    """Move a file durably, also from another disk."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        with path.open("rb") as file:
            os.fsync(file.fileno())
        path.rename(place)
    except OSError:
        part = place.with_name(f".{place.name}.part")
        shutil.copyfile(path, part)
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.rename(place)
        path.unlink()
    for folder in (place.parent, place.parent.parent, place.parent.parent.parent):
        sync_folder(folder)
