"""Disk usage of a store, its limit, and the bytes that the recorder may write meanwhile.

The maintenance process publishes after each measurement how much room is left. The recorder
subtracts the bytes written since then, and records only events once all of it is used up.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import stat
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.store import Store
from amberbox.core.files import replace_file

_SETTLED = (".mcap", ".parquet")  # files that never grow again, but the newest one of a folder
_BLOCK = 512
# A folder that changed this recently may change again without showing it in its time
_COARSE_NS = 100_000_000


def bytes_of(status: os.stat_result) -> int:
    """Return the bytes of a file on its disk, those not written back yet included."""
    return max(status.st_size, status.st_blocks * _BLOCK)


@dataclass(slots=True)
class _Folder:
    """The content of a folder when it was listed; links are files with more than one name."""

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
        """Return the bytes that the store uses now."""
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

    def _folders(self, path: str) -> Iterator[tuple[str, _Folder]]:
        try:
            mtime_ns = os.stat(path).st_mtime_ns  # noqa: PTH116  # a Path each time is half the cost
            known = self._known.get(path)
            if known is None or mtime_ns != known.mtime_ns or _may_hide(known):
                known = self._known[path] = _listed(path, mtime_ns)
            folder = known
        except (FileNotFoundError, NotADirectoryError):  # gone meanwhile
            return
        yield path, folder
        for name in folder.folders:
            yield from self._folders(f"{path}/{name}")

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
    # part the files that may still grow from those that may not
    for name, size in folder.sizes.items():
        if name in folder.links:
            continue
        if name.endswith(_SETTLED) and name != newest and not name.startswith("."):
            folder.settled += size
        else:
            folder.growing.append(name)
    return folder


ALLOWANCE_FILE = "room"
_HISTORY = 1024
# Of constant length: it is written over the line before, in place, many times a minute
_LINE = "{:>20} {:>20} {:>20}\n"


@dataclass(frozen=True, slots=True)
class SpaceStatement:
    """Bytes left when the keeper measured them, with the time by the monotonic clock of this boot.

    With ``enough_bytes`` left, recording may begin again.
    """

    left_bytes: int
    enough_bytes: int
    looked_ns: int


class Allowance:
    """The room left for the recorder: counts down from the newest statement."""

    def __init__(self, store: Path) -> None:
        self._path = store / ALLOWANCE_FILE
        self._written: deque[tuple[int, int]] = deque(maxlen=_HISTORY)
        self._stated = read_statement(self._path)
        self._baseline = 0
        """Bytes that this run had written at the keeper's measurement; the first one is older."""

    def left_bytes(self, written_bytes: int) -> int | None:
        """Return the bytes that a run may still write after ``written_bytes``; None: no bound."""
        self._written.append((time.monotonic_ns(), written_bytes))
        stated = read_statement(self._path) or self._stated
        if stated is not None and stated != self._stated:
            self._stated = stated
            while self._written and self._written[0][0] <= stated.looked_ns:
                _, self._baseline = self._written.popleft()
        return None if stated is None else stated.left_bytes - (written_bytes - self._baseline)

    @property
    def enough_bytes(self) -> int:
        """Return how many bytes must be left before recording begins again."""
        return self._stated.enough_bytes if self._stated is not None else 0


def publish_statement(store: Path, statement: SpaceStatement) -> None:
    """Publish the bytes left to the recorder; the file may be lost at a power cut."""
    line = _LINE.format(statement.left_bytes, statement.enough_bytes, statement.looked_ns)
    descriptor = os.open(store / ALLOWANCE_FILE, os.O_WRONLY | os.O_CREAT, 0o644)
    try:
        os.pwrite(descriptor, line.encode(), 0)
    finally:
        os.close(descriptor)


def read_statement(path: Path) -> SpaceStatement | None:
    """Return the statement of the maintenance process; None if it is missing or incomplete."""
    with suppress(OSError, ValueError):
        left, enough, looked = map(int, path.read_bytes().split())
        return SpaceStatement(left, enough, looked)
    return None


FULL = "full"
RESERVE = "reserve"
_RESERVE_STEP = 1_000_000
_GROWING = 2  # journals that may grow by a file's size before the next measurement: main and bulk
_SHARE = 4  # at most this part of the limit is held free for files that grow
DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT)

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class SpaceBudget:
    """The bytes that a record uses, its limit, and how much of that is held free."""

    used: int
    limit: int
    headroom: int

    @property
    def needed(self) -> int:
        """Return the bytes that have to be deleted now; 0 or less when there is enough space."""
        return self.used + self.headroom - self.limit

    @property
    def left(self) -> int:
        """Return the bytes that may still be written."""
        return self.limit - self.used

    @property
    def is_full(self) -> bool:
        """Return whether even half of the room held free is in use."""
        return self.used + self.headroom // 2 > self.limit


def quota_bytes(store: Store, options: RetentionOptions) -> int:
    """Return the limit of a store, bytes: its quota, or a share of the partition without one."""
    if options.quota is not None:
        return options.quota
    return int(shutil.disk_usage(store.path).total * options.quota_percent / 100)


def space_budget(
    store: Store, options: RetentionOptions, used: int, expected: int = 0
) -> SpaceBudget:
    """Return the budget of a store by its usage, its quota and the room that must stay free.

    ``expected`` are bytes that the maintenance process is about to write itself.
    """
    free = shutil.disk_usage(store.path).free - options.min_free
    limit = max(0, min(quota_bytes(store, options), used + free))
    headroom = min(_GROWING * options.headroom + expected, limit // _SHARE)
    return SpaceBudget(used, limit, headroom)


class FullMark:
    """The file ``full`` in a store: while it exists, only events are recorded."""

    def __init__(self, store: Store) -> None:
        self._path = store.path / FULL
        self.is_set = self._path.exists()

    def set(self, reason: str) -> bool:
        """Set the mark with a reason; return False if it was set already."""
        if self.is_set:
            return False
        replace_file(self._path, f"{reason}\n")
        self.is_set = True
        return True

    def clear(self) -> bool:
        """Remove the mark; False if it did not exist."""
        if not self.is_set:
            return False
        self._path.unlink(missing_ok=True)
        self.is_set = False
        return True


def with_reserve(store: Store, action: Callable[[], Result]) -> Result:
    """Run an action that must write; on a full disk release the reserve for it, bit by bit."""
    while True:
        try:
            return action()
        except OSError as error:
            if error.errno not in DISK_FULL_ERRORS or not shrink_reserve(store.path / RESERVE):
                raise


def shrink_reserve(reserve: Path) -> bool:
    """Free a part of the reserve; False when none is left."""
    try:
        size = reserve.stat().st_size
        if size == 0:
            return False
        os.truncate(reserve, max(0, size - _RESERVE_STEP))
    except FileNotFoundError:
        return False
    return True


PIN_LOCK_FILE = "lock.pins"


@contextmanager
def pin_lock(store: Store) -> Iterator[None]:
    """Hold the lock for pinning and deleting; its holder reads the pins again before deleting.

    Waits for the other holder, which keeps it for a few files at most.
    """
    with (store.path / PIN_LOCK_FILE).open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
