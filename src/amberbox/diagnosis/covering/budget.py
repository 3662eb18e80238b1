"""How much a search may take before it has to say that it did not finish."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


def never() -> bool:
    """Have all the time in the world."""
    return False


@dataclass(frozen=True, slots=True)
class Budget:
    """The most nodes that are opened (a few kB and 0.1 to 1 ms each), and whether time is up.

    ``deadline`` is asked at every node and returns True when the caller wants an end.
    """

    nodes: int = 2_000
    deadline: Callable[[], bool] = never
