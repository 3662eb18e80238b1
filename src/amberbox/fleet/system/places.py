"""Where the system and its teams stand below the server's data folder, and who their members are.

``system/`` is the system, ``teams/<name>/`` are teams; ``members/<robot>`` is what they name as
``where`` of a robot.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.blackbox.folder.folder import BLACK_BOX_FILE, ROBOT_FILE, inspect_folder
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.ids import is_id

SYSTEM, TEAMS, MEMBERS = "system", "teams", "members"
_STATUS = "status"


@dataclass(frozen=True, slots=True)
class Place:
    """A folder of the system level, and what is wrong with it.

    ``store`` is where it records; None where its sources cannot be read, so that it cannot run.
    """

    name: str
    path: Path
    members: frozenset[str] = frozenset()
    store: Path | None = None
    problems: tuple[Problem, ...] = ()


def paths(root: Path) -> dict[str, Path]:
    """Return the folders that are there by name: teams, then the system."""
    found = {path.name: path for path in sorted((root / TEAMS).glob("*")) if is_id(path.name)}
    known = {**found, SYSTEM: root / SYSTEM}
    return {name: path for name, path in known.items() if _is_folder(path)}


def look(root: Path, name: str, path: Path) -> Place:
    """Read a folder's sources; raises nothing for files that are wrong."""
    try:
        folder, _ = inspect_folder(path)
    except (AmberboxError, OSError):
        folder = None
    if folder is None:
        return Place(name, path)
    return Place(name, path, frozenset(_members(root, folder.blocks)), folder.store_path)


def _members(root: Path, blocks: Any) -> Iterator[str]:
    """Yield the robots whose statuses are read: their stores are ours to fill."""
    for block in blocks:
        if block.plugin == _STATUS:
            where = Path(block.config.where).absolute().resolve()
            if where.parent == (root / MEMBERS).resolve() and is_id(where.name):
                yield where.name


def _is_folder(path: Path) -> bool:
    return any((path / name).is_file() for name in (ROBOT_FILE, BLACK_BOX_FILE))
