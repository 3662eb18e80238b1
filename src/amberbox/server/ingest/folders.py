"""Configuration folders of robots, by their hash, in ``DIR/folders/<robot>/<config hash>/``."""

from __future__ import annotations

import asyncio
import os
import shutil
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
from sqlalchemy import Connection, Select, delete, select

from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError
from amberbox.core.files import sync_folder
from amberbox.core.names import is_id, some_names
from amberbox.link.folders import TAKEN_BYTES, FolderError, is_config_hash, is_picture, travels
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import FILE, ServerDatabase, upsert_rows
from amberbox.server.ingest.link_state import log_event
from amberbox.server.schema import FOLDER, ROBOT
from amberbox.server.workers.pool import WorkerPool

FOLDERS = "folders"
_COMING = "coming-"


@dataclass(frozen=True, slots=True)
class FileInfo:
    """A file of a robot's folder."""

    name: str
    bytes: int


@dataclass(frozen=True, slots=True)
class FolderStore:
    """The folders below a server's data folder; a stored folder never changes."""

    root: Path

    def place(self, robot: str, config_hash: str) -> Path:
        """Return the path of a folder, existing or not; raises UsageError for invalid names."""
        if not is_id(robot) or not is_config_hash(config_hash):
            raise UsageError("this is no robot, or no hash of a folder")
        return self.root / FOLDERS / robot / config_hash

    def keep(self, robot: str, config_hash: str, files: Mapping[str, bytes]) -> bool:
        """Store a folder atomically; return False if it exists already."""
        place = self.place(robot, config_hash)
        if place.exists():
            return False
        place.parent.mkdir(parents=True, exist_ok=True)
        coming = Path(tempfile.mkdtemp(prefix=_COMING, dir=place.parent))
        try:
            for name, data in files.items():
                (coming / name).parent.mkdir(parents=True, exist_ok=True)
                with (coming / name).open("xb") as file:
                    file.write(data)
            for name in files:  # all at once: the first sync writes the others too
                with (coming / name).open("rb") as written:
                    os.fsync(written.fileno())
            coming.chmod(0o755)
            coming.rename(place)
        except OSError:
            if place.exists():  # the same folder arrived twice at the same time
                return False
            raise
        finally:
            shutil.rmtree(coming, ignore_errors=True)
        sync_folder(place.parent)
        return True

    def files(self, robot: str, config_hash: str) -> list[FileInfo]:
        """Return the files of a folder, by name; only those that a robot may send."""
        place = self.place(robot, config_hash)
        found = (path for path in sorted(place.rglob("*")) if path.is_file())
        named = ((path.relative_to(place).as_posix(), path) for path in found)
        return [FileInfo(name, path.stat().st_size) for name, path in named if _may_be(name)]

    def read(self, robot: str, config_hash: str, name: str) -> bytes | None:
        """Return the content of a file of a folder; None if there is no such file."""
        place = self.place(robot, config_hash)
        path = place / PurePosixPath(name)
        if not _may_be(name) or path.is_symlink() or not path.is_file():
            return None
        return path.read_bytes()

    def remove(self, robot: str, config_hash: str) -> None:
        """Delete a folder."""
        shutil.rmtree(self.place(robot, config_hash), ignore_errors=True)

    def tidy(self) -> None:
        """Delete folders that were being written when the server ended."""
        for left in (self.root / FOLDERS).glob(f"*/{_COMING}*"):
            shutil.rmtree(left, ignore_errors=True)


class FolderContents(msgspec.Struct, frozen=True):
    """The result of storing a folder: number of files, bytes, and files with masked secrets."""

    files: int
    bytes: int
    masked: list[str]


KEEP_OP = "amberbox.server.ingest.worker:keep"
# Largest number of folders per robot; the oldest are deleted first
MOST = 200
# Largest total size in bytes of the folders of a robot
MOST_BYTES = 512 << 20
_LIMIT_S = 20.0
_MEMORY_BYTES = 1 << 30
_NAMED = 5


@dataclass(frozen=True, slots=True)
class KnownFolder:
    """A stored folder of a robot; ``masked`` are files from which secrets were removed."""

    config_hash: str
    received_ns: int
    files: int
    bytes: int
    masked: int


class FolderService:
    """Stores robots' folders by their hash, so that every configuration stays known.

    Each is unpacked, masked and written by a worker with limits; no code in it is ever run.
    """

    def __init__(
        self,
        folder: Path,
        database: ServerDatabase,
        bus: EventBus,
        clock: Clock,
        worker_pool: WorkerPool,
    ) -> None:
        self.shelf = FolderStore(folder)
        self._database = database
        self._bus = bus
        self._clock = clock
        self._worker_pool = worker_pool
        self._lock = threading.Lock()
        rows = database.rows(select(FOLDER.c.robot, FOLDER.c.config_hash))
        self._known = {(row.robot, row.config_hash) for row in rows}

    async def run(self) -> None:
        """Delete folders that were being written when the server ended; then wait."""
        await asyncio.to_thread(self.shelf.tidy)
        await asyncio.Event().wait()

    def close(self) -> None:
        """Do nothing: no resources are held."""

    def wants(self, robot: str, config_hash: str) -> bool:
        """Return whether a robot's folder is not known yet; from memory."""
        return (robot, config_hash) not in self._known

    def keep(self, robot: str, config_hash: str, packed: bytes) -> bool:
        """Store a packed folder; return False if it is known already.

        Blocks. Raises FolderError for a damaged or too large one, or one with files that may not be
        sent.
        """
        self.shelf.place(robot, config_hash)
        if not self.wants(robot, config_hash):
            return False
        if len(packed) > TAKEN_BYTES:
            raise FolderError(f"a packed folder has at most {TAKEN_BYTES} bytes")
        arguments = {"robot": robot, "config_hash": config_hash, "data": packed}
        answer = self._worker_pool.ask_now(
            KEEP_OP, arguments, _LIMIT_S, _MEMORY_BYTES, origin=robot
        )
        kept = msgspec.msgpack.decode(answer, type=FolderContents)
        with self._lock:
            self._enter(robot, config_hash, kept)
        self._bus.publish(ServerChange("robot", robot, {"config_hash": config_hash}))
        return True

    def kept(self, robot: str) -> list[KnownFolder]:
        """Return the folders of a robot, newest first."""
        rows = self._database.rows(_of(robot).order_by(FOLDER.c.received_ns.desc()))
        return [KnownFolder(r.config_hash, r.received_ns, r.files, r.bytes, r.masked) for r in rows]

    def current(self, robot: str) -> str:
        """Return the hash that a robot stated at its last connection; empty if it never did."""
        with self._database.reading() as connection:
            return _stated(connection, robot)

    def find(self, robot: str, config_hash: str = "") -> Path:
        """Return the path of a folder; without a hash the current one, else the newest.

        Raises UsageError if there is none.
        """
        wanted = config_hash or self.current(robot)
        if (robot, wanted) in self._known:
            return self.shelf.place(robot, wanted)
        found = [] if config_hash else self.kept(robot)
        if not found:
            what = f"the folder of {robot} is not here"
            hint = "the robot sends it when it connects; it may be of an older version"
            raise UsageError(f"{what}: {config_hash[:12]}" if config_hash else what, hint)
        return self.shelf.place(robot, found[0].config_hash)

    def files(self, robot: str, config_hash: str) -> Sequence[FileInfo] | None:
        """Return the files of a folder; None for an unknown one."""
        known = (robot, config_hash) in self._known
        return self.shelf.files(robot, config_hash) if known else None

    def read(self, robot: str, config_hash: str, name: str) -> bytes | None:
        """Return the content of a file of a folder; None if there is no such file or folder."""
        known = (robot, config_hash) in self._known
        return self.shelf.read(robot, config_hash, name) if known else None

    def _enter(self, robot: str, config_hash: str, kept: FolderContents) -> None:
        now_ns = self._clock.wall_ns()
        row = {
            "robot": robot, "config_hash": config_hash, "received_ns": now_ns,
            "files": kept.files, "bytes": kept.bytes, "masked": len(kept.masked),
        }  # fmt: skip
        with self._database.begin() as connection:
            upsert_rows(connection, FOLDER, [row])
            log_event(connection, robot, now_ns, "folder", f"its folder came: {_words(kept)}")
            old = list(_superfluous(connection, robot, config_hash))
            for gone in old:
                chosen = delete(FOLDER).where(FOLDER.c.robot == robot)
                connection.execute(chosen.where(FOLDER.c.config_hash == gone))
        self._known.add((robot, config_hash))
        self._known.difference_update((robot, gone) for gone in old)
        for gone in old:
            self.shelf.remove(robot, gone)


def archived_folder(data: Path, robots: Sequence[str] = ()) -> Path:
    """Return the folder that a robot stated last, or the newest, in a server's data folder.

    Raises UsageError where it has none, or has folders of several robots and none is named.
    """
    database = ServerDatabase(data / FILE, read_only=True)
    newest = select(FOLDER.c.robot, FOLDER.c.config_hash).order_by(FOLDER.c.received_ns)
    with database.reading() as connection:
        rows = [(str(robot), str(hash_)) for robot, hash_ in connection.execute(newest)]
        found = {robot: hash_ for robot, hash_ in rows if not robots or robot in robots}
        stated = {robot: _stated(connection, robot) for robot in found}
    if not found:
        raise UsageError(f"{data} has no folder of {', '.join(robots) or 'a robot'}")
    if len(found) > 1:
        what = f"{data} has folders of {len(found)} robots: {some_names(list(found), 8)}"
        raise UsageError(what, f"name one: {data}/journals/{min(found)}")
    [(robot, hash_)] = found.items()
    chosen = stated[robot] if (robot, stated[robot]) in rows else hash_
    return FolderStore(data).place(robot, chosen)


def _may_be(name: str) -> bool:
    return travels(name) or is_picture(name)


def _of(robot: str) -> Select[Any]:
    return select(FOLDER).where(FOLDER.c.robot == robot)


def _stated(connection: Connection, robot: str) -> str:
    chosen = select(ROBOT.c.config_hash).where(ROBOT.c.robot == robot)
    return str(connection.execute(chosen).scalar() or "")


def _superfluous(connection: Connection, robot: str, newest: str) -> list[str]:
    """Return the hashes of a robot's oldest folders beyond the limits of number and size."""
    stays = {newest, _stated(connection, robot)}
    rows = connection.execute(_of(robot).order_by(FOLDER.c.received_ns.desc())).mappings()
    gone, count, size = [], 0, 0
    for row in rows:
        count, size = count + 1, size + row["bytes"]
        if (count > MOST or size > MOST_BYTES) and row["config_hash"] not in stays:
            gone.append(str(row["config_hash"]))
    return gone


def _words(kept: FolderContents) -> str:
    text = f"{kept.files} files, {kept.bytes / 1e6:.1f} MB"
    if not kept.masked:
        return text
    more = ", ..." if len(kept.masked) > _NAMED else ""
    return (
        f"{text}; masked here, because it was not before: {', '.join(kept.masked[:_NAMED])}{more}"
    )
