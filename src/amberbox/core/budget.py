"""How much one search may cost: nodes, steps and time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of a search; each engine uses those that apply to it.

    ``nodes`` is the maximum number of nodes that are opened or held at a time, None for the default
    of the engine. ``steps`` is the maximum number of steps of a rule program, ``depth`` its deepest
    nesting of goals. A step is a goal that is run or tried again, a fact that is derived, or eight
    characters of a text or one element of a list that a built-in predicate makes. ``is_over`` is
    called regularly and returns True when the caller wants the search to end, since engines read no
    clock; the default, ``bool``, never does.
    """

    nodes: int | None = None
    is_over: Callable[[], bool] = bool
    steps: int = 5_000_000
    depth: int = 400_000

    def most_nodes(self, default: int) -> int:
        """Return the most nodes, given the default of the engine."""
        return default if self.nodes is None else self.nodes
