"""Ctrl-C ends the program quietly at any moment, also while its modules load; other signals."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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


@contextmanager
def called_by_signals(
    function: Callable[[], object], numbers: Sequence[int] = (signal.SIGTERM, signal.SIGINT)
) -> Iterator[None]:
    """Call a function at each of these signals, until the end of the block."""
    before = [(number, signal.signal(number, lambda *_: function())) for number in numbers]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)
