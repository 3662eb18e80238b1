"""What the recorder may still write before the keeper looks again: so a dead keeper is no danger.

The keeper states after each look how much room is left. The recorder subtracts what it has
written since that look, and records nothing but events once all of it is used up.
"""

from __future__ import annotations

import os
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

NAME = "room"
_HISTORY = 1024
_LINE = "{:>20} {:>20} {:>20}\n"
"""Always as long: it is written over the line before, in place, many times a minute."""


@dataclass(frozen=True, slots=True)
class Statement:
    """Bytes that were left when the keeper looked, by the monotonic clock of this boot.

    With ``enough_bytes`` left, recording may begin again.
    """

    left_bytes: int
    enough_bytes: int
    looked_ns: int


class Allowance:
    """The recorder's side: counts down from what the keeper has stated last."""

    def __init__(self, store: Path) -> None:
        self._path = store / NAME
        self._written: deque[tuple[int, int]] = deque(maxlen=_HISTORY)
        self._stated = read(self._path)
        self._baseline = 0
        """What this run had written when the keeper looked; what it finds at first is older."""

    def left_bytes(self, written_bytes: int) -> int | None:
        """Tell what may still be written by a run that has written so much; None: no bound."""
        self._written.append((time.monotonic_ns(), written_bytes))
        stated = read(self._path) or self._stated
        if stated is not None and stated != self._stated:
            self._stated = stated
            self._forget_before(stated.looked_ns)
        return None if stated is None else stated.left_bytes - (written_bytes - self._baseline)

    @property
    def enough_bytes(self) -> int:
        """How much must be left before recording begins again."""
        return self._stated.enough_bytes if self._stated is not None else 0

    def _forget_before(self, looked_ns: int) -> None:
        while self._written and self._written[0][0] <= looked_ns:
            _, self._baseline = self._written.popleft()


def state(store: Path, statement: Statement) -> None:
    """Tell the recorder what is left; lost at a power cut, which costs nothing."""
    line = _LINE.format(statement.left_bytes, statement.enough_bytes, statement.looked_ns)
    descriptor = os.open(store / NAME, os.O_WRONLY | os.O_CREAT, 0o644)
    try:
        os.pwrite(descriptor, line.encode(), 0)
    finally:
        os.close(descriptor)


def read(path: Path) -> Statement | None:
    """Read what the keeper has stated; None where there is no (whole) statement."""
    with suppress(OSError, ValueError):
        left, enough, looked = map(int, path.read_bytes().split())
        return Statement(left, enough, looked)
    return None
