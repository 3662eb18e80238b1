"""Keeps robots' folders by their hash."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Connection, Select, delete, select

from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError
from amberbox.fleet.asking.asking import Asking
from amberbox.fleet.bus import Bus, Change
from amberbox.fleet.database.database import Database
from amberbox.fleet.database.upsert import upsert
from amberbox.fleet.folders.shelf import FileInfo, Shelf
from amberbox.fleet.folders.tables import FOLDER
from amberbox.fleet.folders.worker import Kept
from amberbox.fleet.linkend.events import note
from amberbox.fleet.linkend.tables import ROBOT
from amberbox.link.folders import PACKED_BYTES, FolderError

KEPT = "amberbox.fleet.folders.worker:keep"
MOST = 200
"""Folders of one robot; the ones that came first go first."""
MOST_BYTES = 512 << 20
"""What the folders of one robot take together, at most."""
_LIMIT_S = 20.0
_MEMORY_BYTES = 1 << 30
_NAMED = 5


@dataclass(frozen=True, slots=True)
class KnownFolder:
    """A folder of a robot as it was; ``masked`` files had secrets when they came."""

    config_hash: str
    received_ns: int
    files: int
    bytes: int
    masked: int


class Folders:
    """Keeps robots' folders by their hash: what a robot was told to do stays known.

    Each is unpacked, masked and written by a worker with limits; nothing in it is ever run.
    """

    def __init__(
        self, folder: Path, database: Database, bus: Bus, clock: Clock, asking: Asking
    ) -> None:
        self.shelf = Shelf(folder)
        self._database = database
        self._bus = bus
        self._clock = clock
        self._asking = asking
        self._lock = threading.Lock()
        with database.reading() as connection:
            rows = connection.execute(select(FOLDER.c.robot, FOLDER.c.config_hash))
            self._known = {(row.robot, row.config_hash) for row in rows}

    async def run(self) -> None:
        """Remove what was on its way when the server ended; then there is nothing to do."""
        await asyncio.to_thread(self.shelf.tidy)
        await asyncio.Event().wait()

    def close(self) -> None:
        """Let go of what is held."""

    def wants(self, robot: str, config_hash: str) -> bool:
        """Tell whether a robot's folder is not known yet; from memory."""
        return (robot, config_hash) not in self._known

    def keep(self, robot: str, config_hash: str, packed: bytes) -> bool:
        """Take a folder as it was packed; False if it is known, then nothing changes.

        Blocks. Raises FolderError for what is damaged, too large or has what does not travel.
        """
        self.shelf.place(robot, config_hash)
        if not self.wants(robot, config_hash):
            return False
        if len(packed) > PACKED_BYTES:
            raise FolderError(f"a packed folder has at most {PACKED_BYTES} bytes")
        arguments = {"robot": robot, "config_hash": config_hash, "data": packed}
        answer = self._asking.ask_now(KEPT, arguments, _LIMIT_S, _MEMORY_BYTES, asker=robot)
        kept = msgspec.msgpack.decode(answer, type=Kept)
        with self._lock:
            self._enter(robot, config_hash, kept)
        self._bus.publish(Change("robot", robot, {"config_hash": config_hash}))
        return True

    def kept(self, robot: str) -> list[KnownFolder]:
        """Return the folders of a robot, the newest first."""
        with self._database.reading() as connection:
            rows = connection.execute(_of(robot).order_by(FOLDER.c.received_ns.desc()))
            return [
                KnownFolder(row.config_hash, row.received_ns, row.files, row.bytes, row.masked)
                for row in rows
            ]

    def current(self, robot: str) -> str:
        """Return the hash that a robot stated last, when it connected; empty if it never did."""
        with self._database.reading() as connection:
            return _stated(connection, robot)

    def find(self, robot: str, config_hash: str = "") -> Path:
        """Return where a folder stands; without a hash the one that counts now, else the newest.

        Raises UsageError where there is none.
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
        """List the files of a folder; None for one that is not here."""
        known = (robot, config_hash) in self._known
        return self.shelf.files(robot, config_hash) if known else None

    def read(self, robot: str, config_hash: str, name: str) -> bytes | None:
        """Return a file of a folder; None if there is no such file or folder."""
        known = (robot, config_hash) in self._known
        return self.shelf.read(robot, config_hash, name) if known else None

    def _enter(self, robot: str, config_hash: str, kept: Kept) -> None:
        now_ns = self._clock.wall_ns()
        row = {
            "robot": robot, "config_hash": config_hash, "received_ns": now_ns,
            "files": kept.files, "bytes": kept.bytes, "masked": len(kept.masked),
        }  # fmt: skip
        with self._database.begin() as connection:
            write = upsert(connection.dialect, FOLDER, ("robot", "config_hash"), ())
            connection.execute(write, [row])
            note(connection, robot, now_ns, "folder", f"its folder came: {_words(kept)}")
            old = list(_superfluous(connection, robot, config_hash))
            for gone in old:
                chosen = delete(FOLDER).where(FOLDER.c.robot == robot)
                connection.execute(chosen.where(FOLDER.c.config_hash == gone))
        self._known.add((robot, config_hash))
        self._known.difference_update((robot, gone) for gone in old)
        for gone in old:
            self.shelf.remove(robot, gone)


def _of(robot: str) -> Select[Any]:
    return select(FOLDER).where(FOLDER.c.robot == robot)


def _stated(connection: Connection, robot: str) -> str:
    chosen = select(ROBOT.c.config_hash).where(ROBOT.c.robot == robot)
    return str(connection.execute(chosen).scalar() or "")


def _superfluous(connection: Connection, robot: str, newest: str) -> list[str]:
    """Return the folders of a robot that are too many, or too much, the oldest of them."""
    stays = {newest, _stated(connection, robot)}
    rows = connection.execute(_of(robot).order_by(FOLDER.c.received_ns.desc())).mappings()
    gone, count, size = [], 0, 0
    for row in rows:
        count, size = count + 1, size + row["bytes"]
        if (count > MOST or size > MOST_BYTES) and row["config_hash"] not in stays:
            gone.append(str(row["config_hash"]))
    return gone


def _words(kept: Kept) -> str:
    text = f"{kept.files} files, {kept.bytes / 1e6:.1f} MB"
    if not kept.masked:
        return text
    more = ", ..." if len(kept.masked) > _NAMED else ""
    return (
        f"{text}; masked here, because it was not before: {', '.join(kept.masked[:_NAMED])}{more}"
    )
