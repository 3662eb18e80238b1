"""How much room the server's disk has, and what that means for what comes in."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

LOW_BYTES = 2 << 30
LOW_PART = 0.05
FULL_BYTES = 1 << 30
"""Below this nothing is taken from robots any more: they keep it."""

Usage = Callable[[Path], tuple[int, int, int]]
"""Total, used and free bytes of the disk under a folder."""


@dataclass(frozen=True, slots=True)
class Room:
    """What is free on the disk under the data folder, in bytes."""

    total: int
    free: int

    @property
    def is_low(self) -> bool:
        """Tell whether somebody should do something soon: below 2 GB, or below 5 %."""
        return self.free < LOW_BYTES or self.free < LOW_PART * self.total

    @property
    def is_full(self) -> bool:
        """Tell whether nothing can be taken any more: below 1 GB."""
        return self.free < FULL_BYTES

    def __str__(self) -> str:
        return f"{self.free / (1 << 30):.1f} GB of {self.total / (1 << 30):.0f} GB are free"


def room_of(folder: Path, usage: Usage = shutil.disk_usage) -> Room:
    """Look at the disk under a folder."""
    total, _, free = usage(folder)
    return Room(total, free)
