"""What is to be run: a command, how it ends with the others, and how long it may be silent."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.folder.folder import ROBOT_FILE
from amberbox.blackbox.folder.server import KEY_FILE
from amberbox.core.nodes import load_yaml
from amberbox.monitoring.configuration.tree import FOLDER as COMPONENTS

RECORD, WATCH, LINK = "record", "watch", "link"
REFUSED = 2
"""Exit status of a process that cannot work with its configuration."""


@dataclass(frozen=True, slots=True)
class Child:
    """A process of the box.

    ``stage`` orders the end: all of a stage have ended before the next is asked to. ``end_s`` is
    how long after the stop began it may still be there. ``watchdog_s`` is how long it may give no
    sign of life, ``start_s`` how long until it is ready. ``follows`` is started after it is ready.
    """

    name: str
    command: Sequence[str]
    stage: int = 0
    end_s: float = 3.0
    watchdog_s: float = 60.0
    start_s: float = 300.0
    nice: int = 0
    outlives: bool = False
    """It goes on when the supervisor is killed."""
    follows: str = ""


def children_of(folder: Path, write_s: float, *, quiet: bool = True) -> list[Child]:
    """Return what there is to run for a robot folder, the recorder first.

    The link ends last: it sends what all others have written.
    """
    recorder = Child(
        RECORD, amberbox(RECORD, "--quiet", str(folder)), stage=1, end_s=9.0,
        watchdog_s=max(10.0, 4 * write_s), outlives=True,
    )  # fmt: skip
    words = ("--quiet",) if quiet else ()
    watcher = Child(WATCH, amberbox(WATCH, *words, str(folder)), end_s=4.0, nice=5, follows=RECORD)
    linker = Child(
        LINK, amberbox(LINK, *words, str(folder)), stage=2, end_s=10.0, nice=5, follows=RECORD
    )
    return [recorder, watcher, linker]


def amberbox(*arguments: str) -> list[str]:
    """Return the command of a verb."""
    return [sys.executable, "-m", "amberbox", *arguments]


def is_wanted(child: Child, folder: Path) -> bool:
    """Tell whether a folder, as it is now, has work for a child."""
    if child.name == LINK:
        return has_server(folder)
    return child.name != WATCH or has_components(folder)


def has_server(folder: Path) -> bool:
    """Tell whether a robot folder names a server, and there is a key to it."""
    root = load_yaml(folder / ROBOT_FILE, []) if (folder / ROBOT_FILE).exists() else None
    server = (root.mapping or {}).get("server") if root is not None else None
    keys = (server.mapping or {}) if server is not None else {}
    return bool(keys) and ((folder / KEY_FILE).exists() or "token" in keys)


def has_components(folder: Path) -> bool:
    """Tell whether a robot folder says what is to be monitored."""
    place = folder / COMPONENTS
    return any(place.rglob("*.yaml")) or any(place.rglob("*.yml"))
