"""Tests as the engine sees them: which answers they give while which faults are there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class Sight:
    """A cause (failure mode, or function that is lost) makes a test give an outcome."""

    cause: str
    outcome: str
    detects: float


@dataclass(frozen=True, slots=True)
class Check:
    """Something to read, ask or check.

    The first outcome is that of a sound robot, later ones are graver; each cause that is there
    reaches its outcome with probability ``detects``, and the gravest that is reached is seen
    (noisy-MAX). With no cause the first outcome comes with probability ``sure`` and the others
    share the rest. For two outcomes ``detects`` and ``sure`` give sensitivity
    ``1 - sure * (1 - detects)`` and specificity ``sure``.

    A check that ``reads`` a symptom has the outcomes absent and present, and no sights.
    """

    id: str
    kind: Literal["read", "question", "check"]
    text: str
    role: str = ""
    cost_s: float = 0.0
    risk: float = 0.0
    outcomes: tuple[str, ...] = ("no", "yes")
    sure: float = 0.99
    sights: tuple[Sight, ...] = ()
    reads: str = ""

    def __post_init__(self) -> None:
        if len(self.outcomes) < 2:
            raise UsageError(f"the test {self.id} has fewer than two outcomes")
        if not 0.0 < self.sure <= 1.0:
            raise UsageError(f"the test {self.id} is sure to {self.sure:g}, not in (0, 1]")
        for sight in self.sights:
            self.level(sight.outcome)
            if not 0.0 <= sight.detects <= 1.0:
                what = f"the test {self.id} detects {sight.cause} with {sight.detects:g}"
                raise UsageError(f"{what}, no probability")

    def level(self, outcome: str) -> int:
        """Return how grave an outcome is, 0 for sound; raise UsageError for an unknown one."""
        if outcome not in self.outcomes:
            near = did_you_mean(outcome, self.outcomes)
            what = f"the test {self.id} has no outcome '{outcome}'{near}"
            raise UsageError(what, f"it gives {', '.join(self.outcomes)}")
        return self.outcomes.index(outcome)

    def at_most(self, level: int) -> float:
        """Return the probability of an outcome up to this one while no cause is there."""
        return self.sure + (1 - self.sure) * level / (len(self.outcomes) - 1)


READ_OUTCOMES = ("absent", "present")


def reading(symptom: str, cost_s: float, text: str = "") -> Check:
    """Return the check that reads a symptom on demand."""
    return Check(
        f"read:{symptom}", "read", text or f"Read {symptom}.", cost_s=cost_s,
        outcomes=READ_OUTCOMES, sure=1.0, reads=symptom,
    )  # fmt: skip
