"""Formulas of a fault tree: names, constants and what gates do with their inputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

Operator: TypeAlias = Literal[
    "and", "or", "not", "xor", "iff", "nand", "nor", "imply", "atleast", "cardinality"
]
"""As Open-PSA MEF names them; ``atleast`` is k out of n."""

ARITY: dict[str, tuple[int, int | None]] = {
    "and": (1, None),
    "or": (1, None),
    "not": (1, 1),
    "xor": (2, 2),
    "iff": (2, 2),
    "nand": (1, None),
    "nor": (1, None),
    "imply": (2, 2),
    "atleast": (1, None),
    "cardinality": (1, None),
}
"""The fewest and the most inputs of each operator; None: as many as you like."""

COHERENT = frozenset({"and", "or", "atleast"})
"""Operators with which a failure more never repairs anything."""


@dataclass(frozen=True, slots=True)
class Name:
    """A gate, a basic event or a house event by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class Constant:
    """True or false, whatever happens."""

    value: bool


@dataclass(frozen=True, slots=True)
class Operation:
    """An operator with its inputs.

    ``at_least`` is the k of ``atleast`` and the lower bound of ``cardinality``, ``at_most`` the
    upper bound of ``cardinality``; they mean nothing elsewhere.
    """

    operator: Operator
    inputs: tuple[Formula, ...]
    at_least: int = 0
    at_most: int = 0


Formula: TypeAlias = Name | Constant | Operation


def all_of(*inputs: Formula | str) -> Operation:
    """Return the AND of formulas or names."""
    return Operation("and", _formulas(inputs))


def any_of(*inputs: Formula | str) -> Operation:
    """Return the OR of formulas or names."""
    return Operation("or", _formulas(inputs))


def at_least(count: int, *inputs: Formula | str) -> Operation:
    """Return what is true when ``count`` or more of the inputs are."""
    return Operation("atleast", _formulas(inputs), count)


def none_of(formula: Formula | str) -> Operation:
    """Return the NOT of a formula or name."""
    return Operation("not", _formulas((formula,)))


def parts(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and all formulas inside it, without going through names."""
    waiting = [formula]
    while waiting:
        part = waiting.pop()
        yield part
        if isinstance(part, Operation):
            waiting += reversed(part.inputs)


def names(formula: Formula) -> list[str]:
    """Return the names in a formula, in order, each once."""
    found = (part.name for part in parts(formula) if isinstance(part, Name))
    return list(dict.fromkeys(found))


def _formulas(inputs: tuple[Formula | str, ...]) -> tuple[Formula, ...]:
    return tuple(Name(part) if isinstance(part, str) else part for part in inputs)
