"""The store: a folder of journals and segments, its identity, its locks and its run counter."""

from __future__ import annotations

import fcntl
import json
import os
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from amberbox.blackbox.journal.head import read_head
from amberbox.blackbox.journal.scan import start_record
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
IDENTITY = "store.json"
_RUN = "run"
_LOCKS = {"keep": "keeper", "kept": "keeper"}
"""Locks of the writers that are not called like these."""
_WITNESSES = 3
"""How many journals of each writer are asked for the store's identity."""
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
        run = 1 + max([self._counted(), *self.runs()])
        replace_file(self.path / _RUN, str(run))
        return run

    def _counted(self) -> int:
        try:
            return int((self.path / _RUN).read_text())
        except (OSError, ValueError):
            return 0

    def runs(self) -> list[int]:
        """Return the numbers of the runs of which there are journals."""
        return [run_and_number(p)[0] for w in FOLDERS for p in self.journal_files(w)]


def is_store(path: Path) -> bool:
    """Tell whether a folder is a store, also one that lost its identity's file."""
    return (path / IDENTITY).is_file() or bool(_witnesses(path))


def open_store(path: Path) -> Store:
    """Open a store that exists; where its identity cannot be read, its files tell it.

    Raises UsageError when there is none, AmberboxError when nothing tells its identity.
    """
    stated = stated_id(path)
    if stated:
        return Store(path, stated)
    witnesses = _witnesses(path)
    if witnesses:
        return Store(path, witnesses.most_common(1)[0][0])
    if not (path / IDENTITY).exists():
        raise UsageError(f"{path} is not a store", "name a store or a robot folder")
    stated = stated_id(path)  # it may have been written since
    if stated:
        return Store(path, stated)
    raise AmberboxError(f"{path / IDENTITY} cannot be read", "restore the file from a copy")


def stated_id(path: Path) -> str:
    """Return the identity that a store's own file states; empty where it states none."""
    try:
        content = (path / IDENTITY).read_text()
        found = str(uuid.UUID(json.loads(content)["store_id"]))
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return ""
    return found if found in content else ""


def identity_text(store_id: str) -> str:
    """Return what a store's own file says."""
    return json.dumps({"store_id": store_id, "format": 1})


def _witnesses(path: Path) -> Counter[str]:
    """Count the files of a store by the identity that each of them states."""
    store, found = Store(path, ""), Counter[str]()
    for writer, folder in FOLDERS.items():
        head = read_head(path / folder)
        found.update([head.store_id] if head is not None else [])
        for journal in store.journal_files(writer)[-_WITNESSES:]:
            with suppress(OSError):
                found.update(filter(None, [start_record(journal).get("store_id")]))
    return found


def open_to_write(path: Path) -> Store:
    """Open a store that exists; put right its identity first where all its files name another.

    Raises what ``open_store`` does.
    """
    stated, witnesses = stated_id(path), _witnesses(path)
    found, count = witnesses.most_common(1)[0] if witnesses else ("", 0)
    is_sure = len(witnesses) == 1 and count > 1  # else a journal's first bytes may be the damage
    if found != stated and found and (is_sure or not stated):
        from amberbox.blackbox.keeper.remarks import remark  # the keeper imports stores

        with suppress(OSError):  # a store that cannot be written now: this process knows better
            replace_file(path / IDENTITY, identity_text(found))
        text = f"{IDENTITY} was damaged: the identity that the journals state is in it again"
        remark(Store(path, found), "restored", text, "store")
        return Store(path, found)
    return open_store(path)


def create_store(path: Path) -> Store:
    """Open a store, or make a new one with an identity of its own, for its user and group.

    Raises AmberboxError when the folder cannot be written.
    """
    if is_store(path):
        return open_to_write(path)
    try:
        path.mkdir(mode=0o750, parents=True, exist_ok=True)
        replace_file(path / IDENTITY, identity_text(str(uuid.uuid4())))
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
