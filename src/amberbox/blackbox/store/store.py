"""The store: a folder of journals and segments, its identity, its locks and its run counter.

Only one process writes a store's manifest and the maintenance journal. Other processes (the
command line, the API, the robot's agent) leave requests in small files.
"""

from __future__ import annotations

import json
import os
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from amberbox.blackbox.journal.scan import start_record
from amberbox.blackbox.journal.tail import read_head
from amberbox.blackbox.robot_folder.folder import store_of
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import below, is_file_locked, replace_file, try_lock

KEPT = "kept"  # writer of the box's own records that outlast the data around them
# Folder of each writer's journal, inside the store
FOLDERS = {
    "main": "journal",
    "bulk": "bulk",
    "ring": "ring",
    "watch": "watch",
    "keep": "keep",
    KEPT: "kept",
    "act": "act",
    "experiment": "experiment",
    "detect": "detect",
}
INCIDENTS = "incidents"
IDENTITY = "store.json"
_RUN = "run"
_LOCKS = {"keep": "keeper", KEPT: "keeper"}  # locks of the writers that are not called like these
_WITNESSES = 3  # how many journals of each writer are read for the store's identity


@dataclass(frozen=True, slots=True)
class Store:
    """A store on disk; ``id`` is a UUID created with it, so that a new store at the same path
    differs.
    """

    path: Path
    id: str

    def folder(self, writer: str) -> Path:
        """Return the folder of a writer's journal."""
        return self.path / FOLDERS[writer]

    def journal_files(self, writer: str) -> list[Path]:
        """Return the journal files of a writer in the order they were written.

        Those of the ring that only an incident still holds are among them.
        """
        found = {path.name: path for path in self.folder(writer).glob("*.mcap")}
        if writer == "ring":
            found = {path.name: path for path in self._held()} | found
        return sorted(found.values(), key=run_and_number)

    def journal_path(self, name: str) -> Path:
        """Return the path of a journal called ``folder/file``; an incident may hold it.

        Raises AmberboxError for a name that leads out of the store.
        """
        path = below(self.path, name)
        if not path.exists():
            held = sorted((self.path / INCIDENTS).glob(f"*/{name}"))
            return held[0] if held else path
        return path

    def writers(self) -> list[str]:
        """Return the writers that have a journal in the store."""
        found = [writer for writer in FOLDERS if self.folder(writer).is_dir()]
        if "ring" not in found and any(self._held()):  # these outlast a ring in memory
            found.append("ring")
        return found

    def _held(self) -> Iterator[Path]:
        """Yield the files of the ring that incidents hold."""
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
        """Return the numbers of the runs that have journals."""
        return [run_and_number(p)[0] for w in FOLDERS for p in self.journal_files(w)]


def is_store(path: Path) -> bool:
    """Return whether a folder is a store, also one that lost its identity's file."""
    return (path / IDENTITY).is_file() or bool(_witnesses(path))


def open_store(path: Path) -> Store:
    """Open an existing store; if its identity cannot be read, it is taken from its journals.

    Raises UsageError when there is no store, AmberboxError when its identity is unknown.
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
    """Return the content of a store's identity file."""
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
    """Open an existing store; first correct its identity if all its files have another one.

    Raises the errors of ``open_store``.
    """
    stated, witnesses = stated_id(path), _witnesses(path)
    found, count = witnesses.most_common(1)[0] if witnesses else ("", 0)
    is_sure = len(witnesses) == 1 and count > 1  # else a journal's first bytes may be the damage
    if found != stated and found and (is_sure or not stated):
        with suppress(OSError):  # an unwritable store: used with this id
            replace_file(path / IDENTITY, identity_text(found))
        text = f"{IDENTITY} was damaged: the identity that the journals state is in it again"
        request_event(Store(path, found), "restored", text, "store")
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
    """A lock that prevents a second writer of the same kind in a store while it is held."""

    def __init__(self, store: Store, writer: str) -> None:
        path = store.path / f"lock.{writer}"
        try:
            self._file: IO[str] = path.open("a+")
        except OSError as error:
            raise AmberboxError(
                f"cannot write to the store {store.path}: {error.strerror}",
                "choose a folder that can be written in robot.yaml store.path",
            ) from error
        if not try_lock(self._file):
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
        """Release the lock."""
        self._file.close()


def is_locked(store: Store, writer: str) -> bool:
    """Return whether a process is writing this journal right now."""
    return is_file_locked(store.path / f"lock.{_LOCKS.get(writer, writer)}")


def being_written(path: Path) -> bool:
    """Return whether a journal file is the one that its writer adds to right now."""
    folder, store = path.parent, Store(path.parent.parent, "")
    writer = next((writer for writer, name in FOLDERS.items() if name == folder.name), "")
    newest = max(folder.glob("*.mcap"), key=run_and_number, default=None)
    return newest == path and is_locked(store, writer)


def run_and_number(path: Path) -> tuple[int, int]:
    """Read run and file number from a journal's file name; zeros if it has none."""
    try:
        run, _, number = path.stem.split("-")
        return int(run), int(number)
    except ValueError:
        return 0, 0


REQUESTS = "requests"


@dataclass(frozen=True, slots=True)
class StoreRequest:
    """One request: its kind, when it was made (wall clock and boot clock), and its values."""

    path: Path
    kind: str
    wall_ns: int
    boot_ns: int
    values: Mapping[str, Any]


def submit(store: Store, kind: str, values: Mapping[str, Any], name: str = "") -> Path:
    """Write a request that survives a power cut; its file is removed once it is carried out.

    One with a ``name`` that waits already is left as it is.
    """
    folder = store.path / REQUESTS
    folder.mkdir(exist_ok=True)
    known = next(folder.glob(f"*-{name}.json"), None) if name else None
    if known is not None:
        return known
    wall_ns, boot_ns = time.time_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    path = folder / f"{boot_ns:020d}-{name or f'{os.getpid()}-{uuid.uuid4().hex[:8]}'}.json"
    document = {"kind": kind, "wall_ns": wall_ns, "boot_ns": boot_ns, "values": dict(values)}
    replace_file(path, json.dumps(document))
    return path


def pending(store: Store) -> list[StoreRequest]:
    """Return the requests that are not finished yet, oldest first.

    A file that is not a request is renamed to ``<name>.refused``, with an event. Each process takes
    the kinds that are its own.
    """
    found = []
    for path in sorted((store.path / REQUESTS).glob("*.json")):
        try:
            document = json.loads(path.read_text())
            times = int(document["wall_ns"]), int(document["boot_ns"])
            found.append(
                StoreRequest(path, str(document["kind"]), *times, dict(document["values"]))
            )
        except FileNotFoundError:
            continue
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
            text = f"{REQUESTS}/{path.name} cannot be read: what it asked for was not done"
            with suppress(OSError):  # a full disk: it is refused with the next step
                about = {"kind": "request_refused", "text": text, "source": "keeper"}
                submit(store, "event", about)
                path.rename(path.with_suffix(".refused"))
    return found


def finish(request: StoreRequest) -> None:
    """Remove a request that has been seen to."""
    request.path.unlink(missing_ok=True)


EVENT_REQUEST = "event"


def request_event(store: Store, kind: str, text: str, source: str) -> None:
    """Write an event for the maintenance process; on a full disk it is dropped."""
    with suppress(OSError):
        submit(store, EVENT_REQUEST, {"kind": kind, "text": text, "source": source})


def store_path(where: str | Path) -> Path:
    """Return the path of the store of ``where`` (a store or a robot folder).

    Raises UsageError when there is none.
    """
    path = Path(where)
    if path.parts[:1] in (("https:",), ("http:",)):
        raise UsageError(
            "this takes what is on this computer, not a server",
            "amberbox export URL --format journals downloads what a robot has signed",
        )
    if is_store(path):
        return path
    store = store_of(path)
    if store is not None:
        if is_store(store):
            return store
        raise UsageError(
            f"{path} has no record yet (no store at {store})",
            f"record something first: amberbox record {path}",
        )
    if not path.exists():
        raise UsageError(f"there is nothing at {path}", "name a robot folder or a store")
    raise UsageError(
        f"{path} is neither a store nor a robot folder",
        "a store holds store.json, a robot folder holds robot.yaml and black_box.yaml",
    )
