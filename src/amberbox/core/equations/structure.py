"""Equations as structure: which unknowns each has, and which faults it would show.

Sets of equations, unknowns and faults are bit masks: bit i is number i of the model's list.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum


class Causality(StrEnum):
    """How derivatives and their states may be computed from each other."""

    MIXED = "mixed"
    INTEGRAL = "int"  # the state from the derivative
    DERIVATIVE = "der"  # the derivative from the state


@dataclass(frozen=True, slots=True)
class Structure:
    """A structural model.

    An equation of ``differentials`` says that its second unknown is the derivative of the first,
    and has no other; known variables (sensors, commands) change nothing of a structure.

    Source: Blanke, Kinnaert, Lunze, Staroswiecki, Diagnosis and Fault-Tolerant Control, ch. 5.
    """

    equations: Sequence[str]
    unknowns: Sequence[str]
    faults: Sequence[str]
    variables: Sequence[int]  # by equation, a mask of unknowns
    shown_in: Sequence[int]  # by fault, a mask of the equations that it violates
    differentials: dict[int, tuple[int, int]]  # by equation: state and derivative
    known: Sequence[Sequence[str]] = ()  # by equation, for people

    @property
    def all(self) -> int:
        """All equations, as a mask."""
        return (1 << len(self.equations)) - 1

    def unknowns_of(self, equations: int) -> int:
        """Return the unknowns of equations, as a mask."""
        found = 0
        for equation in bits(equations):
            found |= self.variables[equation]
        return found

    def redundancy(self, equations: int) -> int:
        """Return how many equations there are more than unknowns in them."""
        return equations.bit_count() - self.unknowns_of(equations).bit_count()

    def computable(self, equation: int, causality: Causality) -> int:
        """Return the unknowns that an equation may be used to compute, as a mask."""
        if equation not in self.differentials or causality is Causality.MIXED:
            return self.variables[equation]
        state, derivative = self.differentials[equation]
        return 1 << (state if causality is Causality.INTEGRAL else derivative)


def bits(mask: int) -> Iterator[int]:
    """Yield the numbers of the bits that are set, lowest first."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


def mask_of(numbers: Iterable[int]) -> int:
    """Return the mask whose bits have these numbers."""
    mask = 0
    for number in numbers:
        mask |= 1 << number
    return mask
