"""A mark in a journal: everything before it is durable once ``wait`` has returned."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(slots=True)
class SyncMark:
    """What has to reach the disk; ``wait`` may run in another thread."""

    fds: list[int]
    close: list[int]
    seq: int
    done: Callable[[int], None]

    def wait(self) -> None:
        """Flush everything written before the mark; then ``seq`` is the durable end."""
        try:
            for fd in self.fds:
                os.fdatasync(fd)
        finally:
            for fd in self.close:
                os.close(fd)
        self.done(self.seq)
