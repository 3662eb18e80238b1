"""The store: a folder of journals and segments, its identity, its locks and its run counter."""

from __future__ import annotations

import fcntl
import json
import os
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import below, replace_file

FOLDERS = {
    "main": "journal",
    "bulk": "bulk",
    "ring": "ring",
    "watch": "watch",
    "keep": "keep",
    "kept": "kept",
}
"""Folder of each writer's journal, inside the store."""
INCIDENTS = "incidents"
SEGMENTS = "segments"
_IDENTITY = "store.json"
_RUN = "run"
_LOCKS = {"keep": "keeper", "kept": "keeper"}
"""Locks of the writers that are not called like these."""
_LOCK_TRIES = 10
_LOCK_PAUSE_S = 0.02
"""A reader that asks whether a lock is held holds it itself for some microseconds."""


@dataclass(frozen=True, slots=True)
class Store:
    """A store on disk; ``id`` was made with it and tells it from a copy started anew."""

    path: Path
    id: str

    def folder(self, writer: str) -> Path:
        """Folder of a writer's journal."""
        return self.path / FOLDERS[writer]

    def journal_files(self, writer: str) -> list[Path]:
        """Journal files of a writer in the order they were written.

        Those of the ring that only an incident still holds are among them.
        """
        found = {path.name: path for path in self.folder(writer).glob("*.mcap")}
        if writer == "ring":
            found = {path.name: path for path in self._held()} | found
        return sorted(found.values(), key=run_and_number)

    def journal_path(self, name: str) -> Path:
        """Return where a journal called ``folder/file`` lies; an incident may hold it.

        Raises AmberboxError for a name that leads out of the store.
        """
        path = below(self.path, name)
        if not path.exists():
            held = sorted((self.path / INCIDENTS).glob(f"*/{name}"))
            return held[0] if held else path
        return path

    def writers(self) -> list[str]:
        """Writers that have a journal here."""
        found = [writer for writer in FOLDERS if self.folder(writer).is_dir()]
        if "ring" not in found and any(self._held()):  # a ring in memory goes, these stay
            found.append("ring")
        return found

    def _held(self) -> Iterator[Path]:
        """Give the files of the ring that incidents hold."""
        return (self.path / INCIDENTS).glob(f"*/{FOLDERS['ring']}/*.mcap")

    def next_run(self) -> int:
        """Count one more run, never one that was used before, also after a power cut."""
        run = 1 + max([self._counted(), *self._runs_on_disk()])
        replace_file(self.path / _RUN, str(run))
        return run

    def _counted(self) -> int:
        try:
            return int((self.path / _RUN).read_text())
        except (OSError, ValueError):
            return 0

    def _runs_on_disk(self) -> list[int]:
        return [run_and_number(p)[0] for w in FOLDERS for p in self.journal_files(w)]


def is_store(path: Path) -> bool:
    """Tell whether a folder is a store."""
    return (path / _IDENTITY).is_file()


def open_store(path: Path) -> Store:
    """Open a store that exists.

    Raises AmberboxError when there is none, or its identity cannot be read.
    """
    try:
        identity = json.loads((path / _IDENTITY).read_text())
        return Store(path, str(identity["store_id"]))
    except FileNotFoundError:
        raise UsageError(f"{path} is not a store", "name a store or a robot folder") from None
    except (OSError, ValueError, KeyError) as error:
        raise AmberboxError(
            f"{path / _IDENTITY} cannot be read: {error}", "restore the file from a copy"
        ) from error


def create_store(path: Path) -> Store:
    """Open a store, or make a new one with an identity of its own, for its user and group.

    Raises AmberboxError when the folder cannot be written.
    """
    if is_store(path):
        return open_store(path)
    try:
        path.mkdir(mode=0o750, parents=True, exist_ok=True)
        replace_file(path / _IDENTITY, json.dumps({"store_id": str(uuid.uuid4()), "format": 1}))
    except OSError as error:
        raise AmberboxError(
            f"cannot write to the store {path}: {error.strerror}",
            "choose a folder that can be written in robot.yaml store.path",
        ) from error
    return open_store(path)


class WriterLock:
    """Keeps a second writer of the same kind away from a store for as long as it is held."""

    def __init__(self, store: Store, writer: str) -> None:
        path = store.path / f"lock.{writer}"
        try:
            self._file: IO[str] = path.open("a+")
        except OSError as error:
            raise AmberboxError(
                f"cannot write to the store {store.path}: {error.strerror}",
                "choose a folder that can be written in robot.yaml store.path",
            ) from error
        if not _lock(self._file):
            self._file.seek(0)
            owner = self._file.read().strip() or "unknown"
            self._file.close()
            raise UsageError(
                f"the store {store.path} is being written by process {owner} ({writer})",
                "stop it first, or give this robot a store of its own in robot.yaml",
            )
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Let others write."""
        self._file.close()


def _lock(file: IO[str]) -> bool:
    """Take a lock; try again for a moment, for it may be a reader that looks at it."""
    for _ in range(_LOCK_TRIES):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            time.sleep(_LOCK_PAUSE_S)
        else:
            return True
    return False


def is_locked(store: Store, writer: str) -> bool:
    """Tell whether somebody is writing this journal right now."""
    try:
        with (store.path / f"lock.{writer}").open("r") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def being_written(path: Path) -> bool:
    """Tell whether a journal file is the one that its writer adds to right now."""
    folder, store = path.parent, Store(path.parent.parent, "")
    writer = next((writer for writer, name in FOLDERS.items() if name == folder.name), "")
    newest = max(folder.glob("*.mcap"), key=run_and_number, default=None)
    return newest == path and is_locked(store, _LOCKS.get(writer, writer))


def run_and_number(path: Path) -> tuple[int, int]:
    """Read run and file number from a journal's file name; zeros if it has none."""
    try:
        run, _, number = path.stem.split("-")
        return int(run), int(number)
    except ValueError:
        return 0, 0
