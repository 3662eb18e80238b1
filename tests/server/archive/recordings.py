"""Recordings for the archive's tests: made by the real writer, put as the link puts them."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.blackbox.store.store import FOLDERS, open_store
from amberbox.core.clock import NS
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.journals import JournalKey, PutResult
from amberbox.testing.records import BATTERY, POSE, T0_NS, FakeItem, FakeRun, pose

_MS = 1_000_000
DAY_NS = 24 * 3600 * NS


@dataclass
class Robot:
    """A robot that records into a store of its own and hands its journals in."""

    name: str
    folder: Path
    items: Sequence[FakeItem] = (POSE, BATTERY)
    handed: list[str] = field(default_factory=list)

    @property
    def store(self) -> Path:
        """The robot's store."""
        return self.folder / self.name

    @property
    def store_id(self) -> str:
        """The id of the robot's store."""
        return open_store(self.store).id

    def record(self, start: int, *, files: int = 3, rows: int = 40, at_ns: int = T0_NS) -> FakeRun:
        """Record journals of poses, 10 ms apart, from a number on; return the run."""
        run = FakeRun(self.store, items=self.items)
        for number in range(start, start + files * rows):
            moment = at_ns + number * 10 * _MS
            if (number - start) % rows == 0:
                run.start(moment - 1)
            run.write([(moment, POSE, pose(number)), (moment + 1, BATTERY, {"volts": number / 8})])
            if (number - start) % rows == rows - 1:
                run.rotate()
        run.close()
        return run

    def files(self) -> list[Path]:
        """Return the journals of the store, oldest first."""
        return sorted(p for folder in FOLDERS.values() for p in self.store.glob(f"{folder}/*.mcap"))

    def key(self, path: Path) -> JournalKey:
        """Name a journal as the link does."""
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        return JournalKey(self.name, self.store_id, f"{path.parent.name}/{path.name}", digest)

    def hand_in(self, archive: FolderArchive, path: Path) -> PutResult:
        """Put a copy of a journal into an archive."""
        copy = self.folder / f"upload-{self.name}"
        shutil.copyfile(path, copy)
        self.handed.append(path.name)
        return archive.put(self.key(path), copy)

    def hand_in_all(self, archive: FolderArchive) -> None:
        """Put copies of all journals into an archive."""
        for path in self.files():
            self.hand_in(archive, path)


def positions(table: Any) -> list[tuple[int, float]]:
    """Return seq and x of each row."""
    return list(zip(table.values("seq"), table.values("pose_x"), strict=True))
