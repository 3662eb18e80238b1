"""Integers in constraints: equalities that are solved for one unknown after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

from amberbox.core.contracts import Budget
from amberbox.core.expression import Expression
from amberbox.core.expressions.tree import (
    AddressNode,
    ArithmeticNode,
    ComparisonNode,
    ConstantNode,
    ExpressionNode,
    NegativeNode,
    walk,
)
from amberbox.diagnosis.consistency.satisfiability import Solver

_LARGEST = 10**18

Net: TypeAlias = int  # ports that are connected, and so have one value


@dataclass(frozen=True, slots=True)
class Equality:
    """An equality of integers; the ports are its unknowns."""

    left: ExpressionNode
    right: ExpressionNode
    ports: Sequence[str]


def equalities(constraint: Expression) -> list[Equality]:
    """Return the equalities of a constraint; raises ValueError if it is made of anything else."""
    tree = constraint.tree
    if not isinstance(tree, ComparisonNode) or set(tree.operators) != {"=="}:
        raise ValueError("has int ports and is no equality")
    if not all(_is_known(part) for side in tree.operands for part in walk(side)):
        raise ValueError("has int ports and more than whole numbers, + - * and ==")
    pairs = pairwise(tree.operands)
    return [Equality(left, right, constraint.addresses()) for left, right in pairs]


def _is_known(part: ExpressionNode) -> bool:
    if isinstance(part, ArithmeticNode):
        return part.operator in ("+", "-", "*")
    if isinstance(part, ConstantNode):
        return type(part.value) is int
    return isinstance(part, AddressNode | NegativeNode)


@dataclass(frozen=True, slots=True)
class Equation:
    """An equality between nets, which are given by port; it holds if the literal does."""

    equality: Equality
    nets: Mapping[str, Net]
    literal: int


class IntegerSolver(Solver):
    """A solver whose models agree with equations, as far as propagation shows.

    An equation in which one net has no value yet gives it one. What follows only from several
    equations that are solved together is not found.
    """

    def __init__(self, budget: Budget | None = None) -> None:
        super().__init__(budget)
        self._observations: list[tuple[Mapping[Net, int], _ByNet]] = []

    def add_equations(self, known: Mapping[Net, int], equations: Sequence[Equation]) -> None:
        """Add the equations of one observation, and the values of its nets that are known."""
        by_net: _ByNet = {}
        for equation in equations:
            for net in {*equation.nets.values()}:
                by_net.setdefault(net, []).append(equation)
        self._observations.append((known, by_net))

    def solve(self, assumptions: Sequence[int] = ()) -> bool:
        """Return whether clauses and equations can hold with the assumptions.

        Raises OutOfTimeError when the budget is spent.
        """
        while super().solve(assumptions):
            reasons = [self._against(known, by_net) for known, by_net in self._observations]
            found = [reason for reason in reasons if reason is not None]
            if not found:
                return True
            for reason in found:
                self.add([-literal for literal in sorted(reason)])
        return False

    def _against(self, known: Mapping[Net, int], by_net: _ByNet) -> frozenset[int] | None:
        """Return literals of the model that contradict each other by their equations, or None."""
        values = dict(known)
        because: dict[Net, frozenset[int]] = dict.fromkeys(known, frozenset())
        waiting = deque(equation for net in by_net for equation in by_net[net])
        while waiting:
            equation = waiting.popleft()
            nets = {*equation.nets.values()}
            unknown = [net for net in nets if net not in values]
            if len(unknown) > 1 or not self.holds(equation.literal):
                continue
            reason = frozenset({equation.literal}).union(
                *(because[net] for net in nets if net in values)
            )
            net = unknown[0] if unknown else None
            form = _difference(equation, values, net)
            if form is None:
                continue
            factor, rest = form
            if (rest % factor if factor else rest) != 0:
                return reason
            if net is not None and factor and abs(rest // factor) <= _LARGEST:
                values[net], because[net] = -rest // factor, reason
                waiting.extend(by_net[net])
        return None


_ByNet: TypeAlias = "dict[Net, list[Equation]]"


def _difference(
    equation: Equation, values: Mapping[Net, int], unknown: Net | None
) -> tuple[int, int] | None:
    """Return a and b if an equation is a * unknown + b = 0; None if it is not linear."""
    left = _linear(equation.equality.left, equation.nets, values, unknown)
    right = _linear(equation.equality.right, equation.nets, values, unknown)
    return None if left is None or right is None else (left[0] - right[0], left[1] - right[1])


def _linear(
    tree: ExpressionNode, nets: Mapping[str, Net], values: Mapping[Net, int], unknown: Net | None
) -> tuple[int, int] | None:
    if isinstance(tree, ConstantNode):
        assert isinstance(tree.value, int)
        return 0, tree.value
    if isinstance(tree, AddressNode):
        net = nets[tree.name]
        return (1, 0) if net == unknown else (0, values[net])
    if isinstance(tree, NegativeNode):
        inner = _linear(tree.inner, nets, values, unknown)
        return inner and (-inner[0], -inner[1])
    assert isinstance(tree, ArithmeticNode)
    left = _linear(tree.left, nets, values, unknown)
    right = _linear(tree.right, nets, values, unknown)
    if left is None or right is None:
        return None
    (a, b), (c, d) = left, right
    if tree.operator == "*":
        return None if a and c else (a * d + b * c, b * d)
    sign = 1 if tree.operator == "+" else -1
    return a + sign * c, b + sign * d
