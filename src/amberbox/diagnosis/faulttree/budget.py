"""How much an analysis may take before it has to say that it did not finish."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

CHECK_EVERY = 4096
"""Steps between two looks at the deadline; a power of two."""


def never() -> bool:
    """Have all the time in the world."""
    return False


@dataclass(frozen=True, slots=True)
class Budget:
    """The most nodes that may be held at a time (about 200 bytes each), and whether time is up.

    ``deadline`` is asked now and then and returns True when the caller wants an end: this
    package knows no clock.
    """

    nodes: int = 10_000_000
    deadline: Callable[[], bool] = never


class ExhaustedError(Exception):
    """A budget was used up; ``reason`` says which, in words for the result.

    ``done`` counts how far the work had come.
    """

    def __init__(self, reason: str, done: int = 0) -> None:
        super().__init__(reason)
        self.reason = reason
        self.done = done


def check(budget: Budget, held: int) -> None:
    """Raise ExhaustedError when ``held`` nodes are too many or time is up."""
    if held > budget.nodes:
        raise ExhaustedError(f"more than {budget.nodes:,} nodes")
    if budget.deadline():
        raise ExhaustedError("the time was up")
