"""Minimal cut sets: how many of which order, their sum, and one by one in order of size."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amberbox.diagnosis.faulttree.compiled import Nodes
from amberbox.diagnosis.faulttree.walk import walk

_MOST_TERMS = 400
_FEWEST_TERMS = 8
_MOST_WORK = 2_000_000  # nodes looked at: about a second
_SMALLEST_TERM = 1e-13


@dataclass(frozen=True)
class CutSets:
    """The minimal cut sets of a tree, iterable from small to large without listing them all.

    ``leaves`` and ``sets`` are by part (see ``compiled``), the top one last. With
    ``truncated_at`` sets of more events are left out.
    """

    leaves: tuple[tuple[str | int, ...], ...]
    sets: tuple[Nodes, ...]
    truncated_at: int | None = None

    @cached_property
    def by_order(self) -> tuple[int, ...]:
        """Return how many sets have 0, 1, 2, ... events."""
        bits = max(1, int(self._sum(lambda event: 1)).bit_length())
        packed = int(self._sum(lambda event: 1 << bits))  # a polynomial, one slot per order
        counts: list[int] = []
        while packed and (self.truncated_at is None or len(counts) <= self.truncated_at):
            counts.append(packed & ((1 << bits) - 1))
            packed >>= bits
        while counts and not counts[-1]:
            counts.pop()
        return tuple(counts)

    @property
    def count(self) -> int:
        """Return how many sets there are (may be too large for ``len``)."""
        return sum(self.by_order)

    def __iter__(self) -> Iterator[frozenset[str]]:
        """Yield the sets, those with the fewest events first."""
        for order, count in enumerate(self.by_order):
            if count:
                yield from walk(self.leaves, self.sets, order)

    def rare_event_sum(self, of_event: Mapping[str, float]) -> float:
        """Return the sum of the probabilities of the sets: an upper bound, may exceed 1."""
        return self._power_sum(of_event, 1)

    def upper_bound(self, of_event: Mapping[str, float]) -> float | None:
        """Return the min cut upper bound, 1 - product of (1 - probability of each set).

        None where sets are so probable, or so many, that the sum that it is computed from would
        take too long.
        """
        logarithm = 0.0
        work = sum(len(sets) for sets in self.sets)
        terms = min(_MOST_TERMS, max(_FEWEST_TERMS, _MOST_WORK // max(1, work)))
        for power in range(1, terms + 1):
            term = self._power_sum(of_event, power) / power
            logarithm += term
            if term <= _SMALLEST_TERM * logarithm:
                return -math.expm1(-logarithm)
            if logarithm > 50.0:  # 1 to the last digit
                return 1.0
        return None

    def _power_sum(self, of_event: Mapping[str, float], power: int) -> float:
        """Return the sum over all sets of their probability to a power."""
        if self.truncated_at is None:
            return float(self._sum(lambda event: of_event[event] ** power))
        size = self.truncated_at + 1
        by_order = self._sum(
            lambda event: np.array([0.0, of_event[event] ** power]),
            np.array([1.0]),
            lambda left, right: np.convolve(left, right)[:size],
            _added,
        )
        return float(np.sum(by_order[:size]))

    def _sum(
        self,
        of_event: Callable[[str], Any],
        one: Any = 1,
        product: Callable[[Any, Any], Any] = lambda left, right: left * right,
        total: Callable[[Any, Any], Any] = lambda left, right: left + right,
    ) -> Any:
        """Return the sum over all sets of the product over their events."""
        of_part: list[Any] = []
        for leaves, sets in zip(self.leaves, self.sets, strict=True):
            own = [of_part[leaf] if isinstance(leaf, int) else of_event(leaf) for leaf in leaves]
            values = [one * 0, one][: len(sets)]
            for level, high, low in sets.inner():
                values.append(total(product(own[level], values[high]), values[low]))
            of_part.append(values[-1])
        return of_part[-1]


def _added(left: Any, right: Any) -> Any:
    """Add two polynomials."""
    if len(left) < len(right):
        left, right = right, left
    result = left.copy()
    result[: len(right)] += right
    return result
