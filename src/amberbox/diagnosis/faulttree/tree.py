"""The types of a fault tree: gates, basic events, house events, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from amberbox.diagnosis.faulttree.expression import Expression
from amberbox.diagnosis.faulttree.formula import Formula, names

DEFAULT_MISSION_TIME_H = 8760.0
"""A year: what other tools for Open-PSA files take when nobody says how long a mission is."""

_NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Gate:
    """A named formula; ``label`` is what people call it."""

    name: str
    formula: Formula
    label: str = ""


@dataclass(frozen=True, slots=True)
class BasicEvent:
    """Something that happens or not, of itself.

    ``probability`` is None where nobody has given one. ``expression`` is how a file writes it
    when it is not just a number.
    """

    name: str
    probability: float | None = None
    label: str = ""
    expression: Expression | None = None


@dataclass(frozen=True, slots=True)
class Parameter:
    """A named number of a file."""

    name: str
    expression: Expression
    unit: str = ""


@dataclass(frozen=True, slots=True)
class FaultTree:
    """Gates by name down to basic events; ``top`` is the gate that is analysed.

    ``houses`` are events that are switched on or off by hand. ``mission_time_h`` is what
    expressions with the mission time were computed with.
    """

    name: str
    top: str
    gates: Mapping[str, Gate]
    events: Mapping[str, BasicEvent]
    houses: Mapping[str, bool] = field(default_factory=dict)
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    mission_time_h: float = DEFAULT_MISSION_TIME_H


def fault_tree(
    name: str,
    top: str,
    gates: Mapping[str, Formula],
    probabilities: Mapping[str, float | None],
    houses: Mapping[str, bool] = _NONE,
) -> FaultTree:
    """Make a fault tree of formulas by the name of their gate."""
    return FaultTree(
        name,
        top,
        {gate: Gate(gate, formula) for gate, formula in gates.items()},
        {event: BasicEvent(event, chance) for event, chance in probabilities.items()},
        dict(houses),
    )


def tops(gates: Mapping[str, Gate]) -> list[str]:
    """Return the gates that no other gate uses."""
    used = {name for gate in gates.values() for name in names(gate.formula)}
    return [name for name in gates if name not in used]


def below(tree: FaultTree) -> tuple[list[str], list[str]]:
    """Return the gates and the basic events that the top consists of, in order of a walk."""
    gates: dict[str, None] = {}
    events: dict[str, None] = {}
    waiting = [tree.top]
    while waiting:
        name = waiting.pop()
        if name in tree.events:
            events[name] = None
        elif name in tree.gates and name not in gates:
            gates[name] = None
            waiting += reversed(names(tree.gates[name].formula))
    return list(gates), list(events)
