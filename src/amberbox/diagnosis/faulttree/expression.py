"""Expressions for probabilities, as Open-PSA files write them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Number:
    """A number as it stands in the file."""

    value: float


@dataclass(frozen=True, slots=True)
class ParameterName:
    """A parameter by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class MissionTime:
    """How long the mission is, in hours."""


@dataclass(frozen=True, slots=True)
class Call:
    """A function of expressions; its name is the name of the element in the file."""

    function: str
    arguments: tuple[Expression, ...]


Expression: TypeAlias = Number | ParameterName | MissionTime | Call


def _exponential(rate: float, time: float) -> float:
    return -math.expm1(-rate * time)


def _glm(at_start: float, failures: float, repairs: float, time: float) -> float:
    """Fail on demand, fail at a rate, be repaired at a rate (Open-PSA MEF, GLM)."""
    both = failures + repairs
    return (failures - (failures - at_start * both) * math.exp(-both * time)) / both


def _weibull(scale: float, shape: float, start: float, time: float) -> float:
    return 0.0 if time <= start else -math.expm1(-math.pow((time - start) / scale, shape))


def _difference(first: float, *others: float) -> float:
    return first - sum(others)


def _quotient(first: float, *others: float) -> float:
    return first / math.prod(others)


FUNCTIONS: Mapping[str, tuple[int, int | None, Callable[..., float]]] = {
    "neg": (1, 1, lambda x: -x),
    "add": (1, None, lambda *x: math.fsum(x)),
    "sub": (1, None, _difference),
    "mul": (1, None, lambda *x: math.prod(x)),
    "div": (1, None, _quotient),
    "pow": (2, 2, math.pow),
    "exp": (1, 1, math.exp),
    "log": (1, 1, math.log),
    "log10": (1, 1, math.log10),
    "sqrt": (1, 1, math.sqrt),
    "abs": (1, 1, abs),
    "min": (1, None, lambda *x: min(x)),
    "max": (1, None, lambda *x: max(x)),
    "mean": (1, None, lambda *x: math.fsum(x) / len(x)),
    "pi": (0, 0, lambda: math.pi),
    "exponential": (2, 2, _exponential),
    "GLM": (4, 4, _glm),
    "Weibull": (4, 4, _weibull),
    "uniform-deviate": (2, 2, lambda low, high: (low + high) / 2),
    "normal-deviate": (2, 2, lambda mean, sigma: mean),
    "lognormal-deviate": (3, 3, lambda mean, factor, level: mean),
}
"""The fewest and the most arguments of each function, and its value; of a deviate, its mean."""


def count_problem(kind: str, given: int, fewest: int, most: int | None) -> str:
    """Say what is wrong with the number of inputs of something; empty if nothing is."""
    if fewest <= given and (most is None or given <= most):
        return ""
    wanted = "at least" if most is None else "exactly"
    return f"'{kind}' needs {wanted} {fewest} {'input' if fewest == 1 else 'inputs'}, not {given}"


def value(expression: Expression, parameters: Mapping[str, float], mission_time_h: float) -> float:
    """Compute an expression.

    Raises ArithmeticError or ValueError where it has no value, such as a division by zero.
    """
    if isinstance(expression, Number):
        return expression.value
    if isinstance(expression, ParameterName):
        return parameters[expression.name]
    if isinstance(expression, MissionTime):
        return mission_time_h
    inner = [value(entry, parameters, mission_time_h) for entry in expression.arguments]
    return float(FUNCTIONS[expression.function][2](*inner))


def parameter_names(expressions: Sequence[Expression]) -> list[str]:
    """Return the parameters that expressions use."""
    found: dict[str, None] = {}
    waiting = list(expressions)
    while waiting:
        entry = waiting.pop()
        if isinstance(entry, ParameterName):
            found[entry.name] = None
        elif isinstance(entry, Call):
            waiting += entry.arguments
    return list(found)
