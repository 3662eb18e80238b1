"""The archive in a local folder: journals as files, columns as Delta tables beside them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from amberbox.core.clock import Clock, SystemClock
from amberbox.core.errors import AmberboxError
from amberbox.core.files import sync_folder
from amberbox.fleet.archive import committing, compacting, retaining, suspects
from amberbox.fleet.archive.ageclock import AgeClock
from amberbox.fleet.archive.catalogue import PUT, REFUSED, Catalogue, Source
from amberbox.fleet.archive.committing import Progress
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.journal import checked_key, inspect
from amberbox.fleet.archive.record import ArchiveRecord
from amberbox.fleet.archive.store import (
    Committed,
    JournalKey,
    Missing,
    Retention,
    Stored,
)
from amberbox.fleet.database.database import FILE, Database


class FolderArchive:
    """Keeps what robots have recorded, below a server's data folder.

    ``commit``, ``compact``, ``retain`` and ``sweep`` are for one process at a time: the worker.
    All the rest many may ask at once.
    """

    def __init__(
        self, folder: Path, database: Database | None = None, clock: Clock | None = None
    ) -> None:
        self.layout = Layout(folder)
        self.clock = clock or SystemClock()
        self.layout.tables.mkdir(parents=True, exist_ok=True)
        self.layout.journals.mkdir(exist_ok=True)
        self.catalogue = Catalogue(database or Database(folder / FILE, self.clock))
        self.ages = AgeClock(self.catalogue.database, self.clock)

    def put(self, key: JournalKey, path: Path, *, is_checked: bool = False) -> Stored:
        """Move a verified journal file to its place; one that is here already changes nothing.

        With ``is_checked`` its hash and its chain have just been found to hold.
        Raises AmberboxError for a file that does not hold, or that differs from the one of this
        name that is here: it is refused whole and stays where it was.
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
                return Stored(False, place)
        arrived = inspect(key, path, self.ages.came_ns(), is_checked=is_checked)
        _move(path, place)
        if known is not None:  # what had changed here is replaced by what the robot has
            self.catalogue.change([known], state=PUT, facts=arrived.row["facts"])
            return Stored(True, place)
        return Stored(self.catalogue.add(arrived.row), place)

    def note_missing(self, robot: str, store_id: str, ranges: Sequence[Missing]) -> None:
        """Remember what will not come; saying it twice changes nothing."""
        self.catalogue.note_missing(Source(robot, store_id), ranges)

    def commit(self, every_s: float = 60.0, progress: Progress = committing.unheard) -> Committed:
        """Turn the journals that wait into columns; finish first what was cut short.

        ``progress`` hears of each step (see ``committing``).
        """
        now_ns = self.clock.wall_ns()
        return committing.commit(self.layout, self.catalogue, now_ns, every_s, progress)

    def note_failure(self, journal: str, why: str) -> None:
        """Count that a commit failed over a journal (``robot/store_id/file``, empty: unknown)."""
        suspects.note_failure(self.catalogue, self.clock.wall_ns(), journal, why)

    def try_again(self) -> int:
        """Have journals committed that an older server could not; return how many there are."""
        return suspects.try_again(self.catalogue, self.clock.wall_ns())

    def compact(self) -> int:
        """Join small files of the tables; return how many files went."""
        return compacting.compact(self.layout, self.catalogue)

    def retain(self, rules: Sequence[Retention], now_ns: int | None = None) -> int:
        """Delete what is older than the rules say; return how many journals it concerned.

        The worker is given the time by which to count, for it is the server that hears robots.
        """
        now_ns = self.ages.read().age_ns if now_ns is None else now_ns
        return retaining.retain(self.layout, self.catalogue, rules, now_ns)

    def sweep(self) -> int:
        """Delete files that nothing refers to; return how many. Readers look again."""
        removed = 0
        for path in list(committing.leftovers(self.layout, self.catalogue.schemas())):
            with suppress(FileNotFoundError):
                path.unlink()
                removed += 1
        return removed + retaining.remove_journals(self.layout, self.catalogue)

    def robot(self, *robots: str) -> ArchiveRecord:
        """Open the record of one robot, or of several (all without a name) for queries."""
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
