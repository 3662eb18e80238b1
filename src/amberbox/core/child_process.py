"""A child process: its output line by line, never a flood, and its end together with its parent."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

BURST = 100
PER_S = 5.0
_LINE = 2000
_READ = 1 << 16


def print_line(text: str) -> None:
    """Print a line to stderr; a closed stderr is ignored."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


@dataclass
class ChildOutput:
    """Prints lines of one child: ``burst`` at once, ``per_s`` over time; further lines
    are counted.
    """

    name: str
    emit: Callable[[str], None] = print_line
    burst: float = BURST
    per_s: float = PER_S
    error: str = ""
    """The last line that begins with ``error:``: why it has ended, most likely."""
    _rest: bytes = b""
    _room: float = field(init=False)
    _at_s: float = 0.0
    _left_out: int = 0

    def __post_init__(self) -> None:
        self._room = self.burst

    def feed(self, data: bytes, now_s: float) -> None:
        """Add output of the child; it may end within a line."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[:_LINE]
        self._fill(now_s)
        for line in lines:
            self._print(line[:_LINE].decode(errors="replace").rstrip())

    def end(self, now_s: float) -> None:
        """Print the unfinished last line."""
        if self._rest:
            self.feed(b"\n", now_s)
        self._fill(now_s)

    def _fill(self, now_s: float) -> None:
        self._room = min(self.burst, self._room + (now_s - self._at_s) * self.per_s)
        self._at_s = now_s
        if self._left_out and self._room >= 1:
            count, self._left_out = self._left_out, 0
            self._room -= 1
            self.emit(f"{self.name}: ({count} more line{'s' * (count > 1)}, left out)")

    def _print(self, line: str) -> None:
        if line.startswith("error: "):
            self.error = line.removeprefix("error: ")
        if not line:
            return
        if self._room < 1:
            self._left_out += 1
            return
        self._room -= 1
        self.emit(f"{self.name}: {line}")


def read_all(fd: int) -> bytes:
    """Return what can be read without blocking; empty at the end."""
    found = b""
    with suppress(BlockingIOError):
        while block := os.read(fd, _READ):
            found += block
            if len(found) >= 1 << 20:  # endless output: the rest is read next time
                break
    return found


_PR_SET_PDEATHSIG = 1
_OOM = Path("/proc/self/oom_score_adj")


def end_with_parent(parent: int, number: int) -> None:
    """Let the kernel send this process a signal when the thread that started it ends.

    ``parent`` is the id of that thread's process; exits if it has ended already.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(1)


def drop_protection() -> None:
    """Give up the recorder's protection from the kernel's out-of-memory killer."""
    with suppress(OSError, ValueError):
        if int(_OOM.read_text()) < 0:
            _OOM.write_text("0")
