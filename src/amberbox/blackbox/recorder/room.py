"""The room there is for the record: a reserve for the last events, and when only events fit."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.deletion.allowance import Allowance

RESERVE = "reserve"
"""File in the store that holds room free for the last events."""
FULL = "full"
"""File in the store by which the keeper says, and why, that nothing more may be recorded."""
DISK_FULL = "disk full"
USED_UP = "the room is used up that the keeper had stated"
SPARE_BYTES = 4_000_000
"""Room beside the reserve without which recording would stop again at once."""
_PAUSE_S = 10.0
"""How long a disk is left alone that has refused to make the reserve."""
_TIGHT_BYTES = 256_000
"""Less than this, and even a run's first records would not fit."""


class Room:
    """Holds the reserve of a store, and knows whether everything is recorded or only events.

    A reserve file of no size says that the reserve has been given up, also to the next run.
    """

    def __init__(self, store: Path, reserve_bytes: int) -> None:
        self.reason = ""
        """Why only events are recorded; empty while everything is."""
        self.trouble = ""
        """What keeps the reserve from being made on a disk that is not full; empty if nothing."""
        self._store = store
        self._path = store / RESERVE
        self._wanted_bytes = reserve_bytes
        self._not_before_s = 0.0
        self._allowance = Allowance(store)

    @property
    def spared_bytes(self) -> int:
        """How much of each journal's waiting messages may still go into the reserve's room."""
        return self._wanted_bytes // 8

    def begin(self) -> None:
        """Make the reserve, or find it given up by a run before, or give it up for this one."""
        self.relieve()
        self.look()
        self._note_trouble()

    def _note_trouble(self) -> None:
        short = self._wanted_bytes - (self._size() or 0)
        if short > 0 and not self.reason and not self.trouble:
            self.trouble = "too little room is free"

    def look(self, written_bytes: int = 0, coming_bytes: int = 0) -> None:
        """See whether there is room again, or none any more, for what comes next.

        ``written_bytes`` is what this run has written so far.
        """
        left = self._allowance.left_bytes(written_bytes)
        if self._wanted_bytes:
            self._refill(left)
        given_up = self._wanted_bytes > 0 and self._size() == 0
        is_used_up = left is not None and left < self._least_bytes(coming_bytes)
        self.reason = DISK_FULL if given_up else self._forbidden() or USED_UP * is_used_up

    def _least_bytes(self, coming_bytes: int) -> int:
        """How much must be left by the keeper's word; more than that to begin again."""
        if self.reason != USED_UP:
            return coming_bytes
        return max(coming_bytes, self._allowance.enough_bytes)

    def release(self) -> bool:
        """Give the reserve up for the last events; False if there is none left to give."""
        if not self._size():
            return False
        try:
            os.truncate(self._path, 0)
        except OSError:
            return False
        self.reason = DISK_FULL
        return True

    def relieve(self) -> None:
        """Give the reserve up if next to nothing is free beside it."""
        free = free_bytes(self._store)
        if free is not None and free < _TIGHT_BYTES:
            self.release()

    def _refill(self, left_bytes: int | None) -> None:
        """Make the reserve whole as soon as there is room for it and some more."""
        size = self._size() or 0
        if left_bytes is not None and left_bytes < self._wanted_bytes - size:
            return
        if size >= self._wanted_bytes or time.monotonic() < self._not_before_s:
            return
        free = free_bytes(self._store)
        if free is not None and free < self._wanted_bytes - size + SPARE_BYTES:
            return
        self.trouble = _allocate(self._path, size, self._wanted_bytes)
        self._not_before_s = time.monotonic() + _PAUSE_S if self.trouble else 0.0

    def _size(self) -> int | None:
        """Size of the reserve; None where there never was one."""
        try:
            return self._path.stat().st_size
        except OSError:
            return None

    def _forbidden(self) -> str:
        """Return why the keeper lets nothing but events be recorded, if it does."""
        try:
            why = (self._store / FULL).read_text(errors="replace").strip()
        except OSError:
            return ""
        return f"store is full ({why})" if why else "store is full"


def _allocate(path: Path, size: int, wanted_bytes: int) -> str:
    """Give a file real blocks up to a size; return what the disk says against it."""
    existed = path.exists()
    try:
        with path.open("ab") as file:
            os.posix_fallocate(file.fileno(), 0, wanted_bytes)
    except OSError as error:
        with suppress(OSError):
            os.truncate(path, size) if existed else path.unlink()
        return error.strerror or str(error)
    return ""


def free_bytes(folder: Path) -> int | None:
    """Return the room that is free for everybody; None where the file system does not know."""
    try:
        status = os.statvfs(folder)
    except OSError:
        return None
    return status.f_bavail * status.f_frsize if status.f_blocks else None
