"""Ctrl-C: ends the program quietly at any moment, also while its modules load."""

from __future__ import annotations

import os
from types import FrameType


class Interrupt:
    """Handles SIGINT: ends the process at once while modules load, raises KeyboardInterrupt
    afterwards.

    ``came`` is true once it was raised, even if a library turned it into another error.
    """

    STATUS = 130

    def __init__(self) -> None:
        self.loading = True
        self.came = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal."""
        if self.loading:
            os._exit(self.STATUS)
        self.came = True
        raise KeyboardInterrupt
