"""Files that are coming in: a piece is written where it belongs, and durable before it counts."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.files import sync_folder
from amberbox.link.uploads import is_digest, is_journal_name, is_store_id


class PieceError(ValueError):
    """A piece that cannot be taken; ``offset`` is where the next one has to begin."""

    def __init__(self, text: str, offset: int) -> None:
        super().__init__(text)
        self.offset = offset


@dataclass(frozen=True, slots=True)
class Incoming:
    """One journal on its way, told by its content: the same name may come with another one."""

    robot: str
    store_id: str
    journal: str
    sha256: str
    size: int

    def problem(self) -> str:
        """Say what is wrong with what it calls itself; empty where nothing is."""
        if not is_store_id(self.store_id):
            return "no store has this id"
        if not is_journal_name(self.journal):
            return "no journal has this name"
        return "" if is_digest(self.sha256) and self.size > 0 else "without size or SHA-256"

    @property
    def part(self) -> Path:
        """Where its pieces are collected, below the server's folder."""
        folder, _, file = self.journal.partition("/")
        name = f"{folder}-{file}-{self.sha256[:16]}.part"
        return Path("incoming", self.robot, self.store_id, name)


def parts(root: Path, robot: str) -> list[Path]:
    """Return the files of a robot that are coming in."""
    return list((root / "incoming" / robot).glob("*/*.part"))


def held(root: Path, incoming: Incoming) -> int:
    """Return how many bytes of it are here."""
    try:
        return min((root / incoming.part).stat().st_size, incoming.size)
    except FileNotFoundError:
        return 0


def add(root: Path, incoming: Incoming, offset: int, piece: bytes, crc: int) -> int:
    """Write a piece; return the offset of the next one. What was written before stays as it is.

    Raises PieceError when it does not begin where the last one ended, is damaged or too long;
    OSError when the disk does not take it.
    """
    at = held(root, incoming)
    if offset != at:
        raise PieceError(f"the next piece begins at {at}", at)
    if zlib.crc32(piece) != crc:
        raise PieceError("the piece was damaged on its way", at)
    if at + len(piece) > incoming.size:
        raise PieceError("the piece goes beyond the end", at)
    path = root / incoming.part
    is_new = not path.exists()
    if is_new:
        path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o640)
    try:
        _write(descriptor, piece, at)
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)
    if is_new:
        sync_folder(path.parent)
    return at + len(piece)


def _write(descriptor: int, piece: bytes, at: int) -> None:
    """Write all of a piece, or leave the file as long as it was."""
    view, to = memoryview(piece), at
    try:
        while view:
            count = os.pwrite(descriptor, view, to)
            view, to = view[count:], to + count
    except OSError:
        os.ftruncate(descriptor, at)
        raise


def drop(root: Path, incoming: Incoming) -> None:
    """Forget the pieces: the file begins anew."""
    (root / incoming.part).unlink(missing_ok=True)
