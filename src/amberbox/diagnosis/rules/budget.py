"""How much work a question may cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True)
class Budget:
    """Most steps, deepest nesting of goals, and a clock of the caller's that says when to stop.

    A step is a goal that is run or tried again, a fact that is derived, or eight characters of a
    text or one element of a list that a built-in predicate makes.
    """

    steps: int = 5_000_000
    depth: int = 400_000
    is_over: Callable[[], bool] = _never
