"""What is examined: a robot folder, its store, and what the store says about its traffic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from amberbox.blackbox.doctor.traffic import Traffic, traffic
from amberbox.blackbox.folder.folder import RobotFolder, inspect_folder, store_of
from amberbox.blackbox.folder.robot import StoreOptions
from amberbox.blackbox.store import Store, is_store, open_store
from amberbox.core.errors import AmberboxError, Problem


@dataclass(frozen=True)
class Subject:
    """A robot folder as far as it can be read; ``folder`` is None if it has errors."""

    path: Path
    folder: RobotFolder | None
    problems: Sequence[Problem]
    store_path: Path
    options: StoreOptions

    @cached_property
    def store(self) -> Store | None:
        """The store, if something has been recorded."""
        return open_store(self.store_path) if is_store(self.store_path) else None

    @cached_property
    def traffic(self) -> Traffic | None:
        """How much is written per day; None if too little is recorded to tell."""
        return traffic(self.store) if self.store else None

    @property
    def ground(self) -> Path:
        """The store, or the nearest folder that is there: what lies on the same disk."""
        place = self.store_path.resolve()
        return next(path for path in (place, *place.parents) if path.is_dir())


def subject(path: str | Path) -> Subject:
    """Read a robot folder; raise UsageError if there is nothing at ``path``."""
    folder, problems = inspect_folder(path)
    place = Path(path) if Path(path).is_dir() else Path(path).parent
    if folder is not None:
        return Subject(place, folder, problems, folder.store_path, folder.robot.store)
    return Subject(place, None, problems, _store_path(place), StoreOptions())


def _store_path(place: Path) -> Path:
    """Return where the record lies although the configuration has errors."""
    try:
        found = store_of(place)
    except AmberboxError:  # robot.yaml itself
        found = None
    return found or place / StoreOptions().path
