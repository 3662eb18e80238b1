"""How many bytes a store takes, asked many times a second: what cannot have changed is not read."""

from __future__ import annotations

import os
import shutil
import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

_SETTLED = (".mcap", ".parquet")
"""Files that never grow again, but the newest one of a folder."""
_BLOCK = 512
_COARSE_NS = 100_000_000
"""A folder that changed this recently may change again without showing it in its time."""


def bytes_of(status: os.stat_result) -> int:
    """Bytes that a file takes from its disk, or will once they are written back."""
    return max(status.st_size, status.st_blocks * _BLOCK)


def free_bytes(path: Path) -> int:
    """Room that is left on the partition for processes without privileges."""
    return shutil.disk_usage(path).free


def total_bytes(path: Path) -> int:
    """Size of the partition."""
    return shutil.disk_usage(path).total


@dataclass(slots=True)
class _Folder:
    """What a folder held when it was listed; links are files with more than one name."""

    listed_ns: int
    mtime_ns: int
    sizes: dict[str, int] = field(default_factory=dict)
    links: dict[str, tuple[int, int]] = field(default_factory=dict)
    growing: list[str] = field(default_factory=list)
    folders: list[str] = field(default_factory=list)
    settled: int = 0


class DiskUse:
    """Adds up a store's files: each inode once, in whole blocks, other partitions left out."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._known: dict[str, _Folder] = {}

    def measure(self) -> int:
        """Return the bytes that the store takes now."""
        links: dict[int, int] = {}
        total, seen = 0, set()
        for path, folder in self._folders(self._root):
            seen.add(path)
            total += folder.settled + sum(self._now(path, name) for name in folder.growing)
            links.update(folder.links.values())
        for path in self._known.keys() - seen:
            del self._known[path]
        return total + sum(links.values())

    def sizes(self, folder: str) -> Mapping[str, int]:
        """Return the names in a folder of the store and their bytes, as measured last."""
        known = self._known.get(f"{self._root}/{folder}")
        return known.sizes if known else {}

    def held(self, folder: str) -> frozenset[str]:
        """Name the files of a folder that have another name elsewhere."""
        known = self._known.get(f"{self._root}/{folder}")
        return frozenset(known.links) if known else frozenset()

    def _folders(self, path: str) -> Iterator[tuple[str, _Folder]]:
        try:
            folder = self._folder(path)
        except (FileNotFoundError, NotADirectoryError):  # gone meanwhile
            return
        yield path, folder
        for name in folder.folders:
            yield from self._folders(f"{path}/{name}")

    def _folder(self, path: str) -> _Folder:
        mtime_ns = os.stat(path).st_mtime_ns  # noqa: PTH116  # a Path each time is half the cost
        known = self._known.get(path)
        if known is None or mtime_ns != known.mtime_ns or _may_hide(known):
            known = self._known[path] = _listed(path, mtime_ns)
        return known

    def _now(self, path: str, name: str) -> int:
        try:
            return bytes_of(os.lstat(f"{path}/{name}"))
        except FileNotFoundError:
            return 0


def _may_hide(known: _Folder) -> bool:
    return known.listed_ns - known.mtime_ns < _COARSE_NS


def _listed(path: str, mtime_ns: int) -> _Folder:
    folder = _Folder(time.time_ns(), mtime_ns)
    newest = ""
    with os.scandir(path) as entries:
        for entry in entries:
            try:
                status = entry.stat(follow_symlinks=False)
            except FileNotFoundError:
                continue
            if stat.S_ISDIR(status.st_mode):
                folder.folders.append(entry.name)
                continue
            folder.sizes[entry.name] = bytes_of(status)
            if status.st_nlink > 1:
                folder.links[entry.name] = (status.st_ino, bytes_of(status))
            if entry.name.endswith(_SETTLED[0]):
                newest = max(newest, entry.name)
    _settle(folder, newest)
    return folder


def _settle(folder: _Folder, newest: str) -> None:
    """Part the files that may still grow from those that may not."""
    for name, size in folder.sizes.items():
        if name in folder.links:
            continue
        if name.endswith(_SETTLED) and name != newest and not name.startswith("."):
            folder.settled += size
        else:
            folder.growing.append(name)
