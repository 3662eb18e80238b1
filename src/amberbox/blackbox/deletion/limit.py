"""How much room a record may take, and the mark that says when it has none left."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from amberbox.blackbox.deletion.usage import free_bytes, total_bytes
from amberbox.blackbox.keeper.options import KeeperOptions
from amberbox.blackbox.store import Store
from amberbox.core.files import replace_file

FULL = "full"
RESERVE = "reserve"
_RESERVE_STEP = 1_000_000
_GROWING = 2
"""Journals that may grow by a file's size before the next look: those of main and bulk."""
_SHARE = 4
"""At most this part of the limit is held free for files that grow."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
"""What a disk says that takes nothing more."""

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Room:
    """What a record takes, what it may take, and how much of that is held free."""

    used: int
    limit: int
    headroom: int

    @property
    def needed(self) -> int:
        """Bytes that have to go now; 0 or less when there is room."""
        return self.used + self.headroom - self.limit

    @property
    def left(self) -> int:
        """Bytes that may still be written."""
        return self.limit - self.used

    @property
    def is_full(self) -> bool:
        """Tell whether even half of what is held free is in use."""
        return self.used + self.headroom // 2 > self.limit


def quota_bytes(store: Store, options: KeeperOptions) -> int:
    """Return the most that a store may take: its quota, or a share of the partition without one."""
    if options.quota is not None:
        return options.quota
    return int(total_bytes(store.path) * options.quota_percent / 100)


def room(store: Store, options: KeeperOptions, used: int, expected: int = 0) -> Room:
    """Compare what a store takes with its quota and with what must stay free beside it.

    ``expected`` are bytes that the keeper is about to write itself.
    """
    free = free_bytes(store.path) - options.min_free
    limit = max(0, min(quota_bytes(store, options), used + free))
    headroom = min(_GROWING * options.headroom + expected, limit // _SHARE)
    return Room(used, limit, headroom)


class FullMark:
    """The file ``full`` in a store: while it is there, nothing but events is recorded."""

    def __init__(self, store: Store) -> None:
        self._path = store.path / FULL
        self.is_set = self._path.exists()

    def set(self, reason: str) -> bool:
        """Leave the mark; False if it was there already."""
        if self.is_set:
            return False
        replace_file(self._path, f"{reason}\n")
        self.is_set = True
        return True

    def clear(self) -> bool:
        """Remove the mark; False if there was none."""
        if not self.is_set:
            return False
        self._path.unlink(missing_ok=True)
        self.is_set = False
        return True


def with_reserve(store: Store, action: Callable[[], Result]) -> Result:
    """Do what must be written down; on a full disk give up the reserve for it, bit by bit."""
    while True:
        try:
            return action()
        except OSError as error:
            if error.errno not in NO_ROOM or not shrink(store.path / RESERVE):
                raise


def shrink(reserve: Path) -> bool:
    """Give a part of the reserve back to the disk; False when there is none left."""
    try:
        size = reserve.stat().st_size
        if size == 0:
            return False
        os.truncate(reserve, max(0, size - _RESERVE_STEP))
    except FileNotFoundError:
        return False
    return True
