"""What children print: line by line with their name before it, and never too much of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

BURST = 100
PER_S = 5.0
_LINE = 2000
_READ = 1 << 16


def say(text: str) -> None:
    """Print a line on stderr, for as long as somebody reads it."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


@dataclass
class Voice:
    """The lines of one child; ``BURST`` at once, ``PER_S`` in the long run, the rest is counted."""

    name: str
    say: Callable[[str], None] = say
    error: str = ""
    """The last line that begins with ``error:``: why it has ended, most likely."""
    _rest: bytes = b""
    _room: float = BURST
    _at_s: float = 0.0
    _left_out: int = 0

    def hear(self, data: bytes, now_s: float) -> None:
        """Take what has been printed; it may end within a line."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[:_LINE]
        self._fill(now_s)
        for line in lines:
            self._print(line[:_LINE].decode(errors="replace").rstrip())

    def end(self, now_s: float) -> None:
        """Print what is left."""
        if self._rest:
            self.hear(b"\n", now_s)
        self._fill(now_s)

    def _fill(self, now_s: float) -> None:
        self._room = min(BURST, self._room + (now_s - self._at_s) * PER_S)
        self._at_s = now_s
        if self._left_out and self._room >= 1:
            count, self._left_out = self._left_out, 0
            self._room -= 1
            self.say(f"{self.name}: ({count} more line{'s' * (count > 1)}, left out)")

    def _print(self, line: str) -> None:
        if line.startswith("error: "):
            self.error = line.removeprefix("error: ")
        if not line:
            return
        if self._room < 1:
            self._left_out += 1
            return
        self._room -= 1
        self.say(f"{self.name}: {line}")


def read_all(fd: int) -> bytes:
    """Return what can be read without waiting; nothing at the end."""
    found = b""
    with suppress(BlockingIOError):
        while block := os.read(fd, _READ):
            found += block
            if len(found) >= 1 << 20:  # one that prints without end: the rest comes next time
                break
    return found
