"""Positions in a writer's journal, and how far it reaches as its robot states it."""

from __future__ import annotations

from typing import Annotated, NamedTuple, TypeAlias

import msgspec
from msgspec import Meta

LARGEST = 2**62
"""Largest number that a robot may send: sums and ends of ranges still fit into 64 bits."""

Count: TypeAlias = Annotated[int, Meta(ge=0, le=LARGEST)]
"""A number, size or position that a robot sends."""
TimeNs: TypeAlias = Annotated[int, Meta(ge=-LARGEST, le=LARGEST)]
"""A time, duration or clock offset in nanoseconds that a robot sends; until the year 2116."""


def is_in_range(*numbers: int) -> bool:
    """Tell whether numbers that a robot sent fit into databases, columns and times."""
    return all(-LARGEST <= number <= LARGEST for number in numbers)


class Place(NamedTuple):
    """A place in a writer's journal: everything before ``(run, seq)``."""

    run: Count = 0
    seq: Count = 0


START = Place()


class RunEnd(msgspec.Struct, frozen=True, array_like=True):
    """One run of a writer on the robot's disk: which boot wrote it, and where it ends now.

    ``closed`` says that nobody writes it any more, and that its end survives a power cut.
    """

    run: Count
    boot: str
    end_seq: Count
    closed: bool = True


class Reach(msgspec.Struct, frozen=True, array_like=True):
    """How far a writer's journal reaches: its oldest row, its end, and what a power cut leaves."""

    oldest: Place
    end: Place
    durable: Place
    runs: tuple[RunEnd, ...] = ()

    def problem(self) -> str:
        """Say what cannot be true in it; empty where all can."""
        if min(*self.oldest, *self.end, *self.durable) < 0:
            return "a position below 0"
        numbers = [run.run for run in self.runs]
        ends = [run.end_seq for run in self.runs]
        if not is_in_range(*self.oldest, *self.end, *self.durable, *ends, *numbers):
            return "a position that is out of range"
        if self.durable > self.end:
            return "more is durable than was written"
        if numbers != sorted(set(numbers)):
            return "runs out of order"
        return "a run that ends below 0" if any(run.end_seq < 0 for run in self.runs) else ""
