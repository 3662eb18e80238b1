"""Positions in a writer's journal, and how far it reaches as its robot states it."""

from __future__ import annotations

from typing import NamedTuple

import msgspec


class Place(NamedTuple):
    """A place in a writer's journal: everything before ``(run, seq)``."""

    run: int = 0
    seq: int = 0


START = Place()
LARGEST = 2**63 - 1


class RunEnd(msgspec.Struct, frozen=True, array_like=True):
    """One run of a writer on the robot's disk: which boot wrote it, and where it ends now.

    ``closed`` says that nobody writes it any more, and that its end survives a power cut.
    """

    run: int
    boot: str
    end_seq: int
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
        ends = (run.end_seq for run in self.runs)
        if max(*self.oldest, *self.end, *self.durable, *ends) > LARGEST:
            return "a position that is no number of 64 bits"
        if self.durable > self.end:
            return "more is durable than was written"
        numbers = [run.run for run in self.runs]
        if numbers != sorted(set(numbers)) or any(abs(n) > LARGEST for n in numbers):
            return "runs out of order"
        return "a run that ends below 0" if any(run.end_seq < 0 for run in self.runs) else ""
