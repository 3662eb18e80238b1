"""The files of a robot folder as they lie there: whether one was changed, without reading it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.folder.folder import BLACK_BOX_FILE, ROBOT_FILE
from amberbox.blackbox.folder.server import KEY_FILE

Footprint = frozenset[tuple[str, int, int]]


def footprint(folder: Path, store: Path) -> Footprint:
    """Return name, size and time of change of each file; not of the store and hidden ones."""
    return frozenset(_files(folder, store.resolve()))


def _files(folder: Path, store: Path) -> Iterator[tuple[str, int, int]]:
    with suppress(OSError):  # a folder that goes while it is read is another one next time
        for path in folder.iterdir():
            if path.name.startswith(".") or path.name == "__pycache__" or path.resolve() == store:
                continue
            if path.is_dir() and not path.is_symlink():
                yield from _files(path, store)
            else:
                about = path.stat()
                yield str(path), about.st_size, about.st_mtime_ns


def linked_by(folder: Path) -> bytes:
    """Return the key to the server: it is no part of the configuration's hash."""
    with suppress(OSError):
        return (folder / KEY_FILE).read_bytes()
    return b""


def recorded_by(folder: Path) -> str:
    """Return a hash of what the recorder goes by; only a new recorder takes another one."""
    total = hashlib.sha256()
    for name in (ROBOT_FILE, BLACK_BOX_FILE):
        with suppress(OSError):
            total.update(name.encode() + b"\0" + (folder / name).read_bytes())
    return total.hexdigest()
