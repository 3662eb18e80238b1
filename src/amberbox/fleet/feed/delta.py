"""Changes as they are sent: encoded once, numbered, held for a while for those who come back."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias, get_args

import msgspec

Kind: TypeAlias = Literal[
    "presence", "status", "levels", "ages", "event", "diagnosis", "alarm", "job", "fetch"
]  # fmt: skip
KINDS: Final[frozenset[str]] = frozenset(get_args(Kind))
PLAIN: Final[frozenset[str]] = KINDS - {"ages", "levels"}
"""The kinds that somebody hears who names none."""
HELD = 10_000
HELD_BYTES = 64 << 20

_encode = msgspec.json.Encoder().encode


@dataclass(frozen=True, slots=True)
class Delta:
    """One change: ``text`` is its JSON, ``at_s`` when it was made, ``owner`` whose job it is."""

    number: int
    kind: Kind
    robot: str
    text: str
    at_s: float
    owner: str = ""


def message(number: int, kind: str, robot: str, data: Any) -> str:
    """Write a message: number, kind, robot, data."""
    return _encode({"number": number, "kind": kind, "robot": robot, "data": data}).decode()


class Ring:
    """The newest changes. ``number`` is that of the last one; numbers go on without a hole.

    They begin with the time of the start in microseconds: what somebody had seen before the
    server was started again is never taken for something that is held now.
    """

    def __init__(self, start_ns: int, held: int = HELD, held_bytes: int = HELD_BYTES) -> None:
        self.number = start_ns // 1000
        self._deltas: deque[Delta] = deque()
        self._held = held
        self._held_bytes = held_bytes
        self._bytes = 0

    def add(self, kind: Kind, robot: str, data: Any, at_s: float, owner: str = "") -> Delta:
        """Number a change and hold it."""
        self.number += 1
        text = message(self.number, kind, robot, data)
        delta = Delta(self.number, kind, robot, text, at_s, owner)
        self._deltas.append(delta)
        self._bytes += len(text)
        while len(self._deltas) > self._held or self._bytes > self._held_bytes:
            self._bytes -= len(self._deltas.popleft().text)
        return delta

    def holds(self, number: int) -> bool:
        """Tell whether everything behind a number is held."""
        return self.number - len(self._deltas) <= number <= self.number

    def after(self, number: int) -> Iterator[Delta]:
        """Give what is held behind a number, oldest first."""
        count = min(max(self.number - number, 0), len(self._deltas))
        return (self._deltas[index] for index in range(-count, 0))
