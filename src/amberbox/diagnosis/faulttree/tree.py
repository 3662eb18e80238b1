"""The types of a fault tree: formulas, gates, basic and house events, parameters; validation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from amberbox.core.errors import Problem, did_you_mean
from amberbox.diagnosis.faulttree.periodic_test import periodic_test


@dataclass(frozen=True, slots=True)
class Number:
    """A number with its text in the file."""

    value: float


@dataclass(frozen=True, slots=True)
class ParameterName:
    """A parameter by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class MissionTime:
    """How long the mission is, in hours."""


@dataclass(frozen=True, slots=True)
class FunctionCall:
    """A function of expressions; its name is the name of the element in the file."""

    function: str
    arguments: tuple[Expression, ...]


Expression: TypeAlias = Number | ParameterName | MissionTime | FunctionCall


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


# The fewest and the most arguments of each function, and its value; of a deviate, its mean
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
    "periodic-test": (0, None, periodic_test),  # 4, 5 or 11
    "uniform-deviate": (2, 2, lambda low, high: (low + high) / 2),
    "normal-deviate": (2, 2, lambda mean, sigma: mean),
    "lognormal-deviate": (3, 3, lambda mean, factor, level: mean),
}


def count_problem(kind: str, given: int, fewest: int, most: int | None) -> str:
    """Return the problem with the number of inputs of something; empty if it is valid."""
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
        elif isinstance(entry, FunctionCall):
            waiting += entry.arguments
    return list(found)


# As Open-PSA MEF names them; atleast is k out of n
Operator: TypeAlias = Literal[
    "and", "or", "not", "xor", "iff", "nand", "nor", "imply", "atleast", "cardinality"
]

# The fewest and the most inputs of each operator; None: as many as you like
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

# Operators with which a failure more never repairs anything
COHERENT = frozenset({"and", "or", "atleast"})


@dataclass(frozen=True, slots=True)
class Name:
    """A gate, a basic event or a house event by its name."""

    name: str


@dataclass(frozen=True, slots=True)
class BooleanConstant:
    """A constant, true or false."""

    value: bool


@dataclass(frozen=True, slots=True)
class GateOperation:
    """An operator with its inputs.

    ``at_least`` is the k of ``atleast`` and the lower bound of ``cardinality``, ``at_most`` the
    upper bound of ``cardinality``; they mean nothing elsewhere.
    """

    operator: Operator
    inputs: tuple[Formula, ...]
    at_least: int = 0
    at_most: int = 0


Formula: TypeAlias = Name | BooleanConstant | GateOperation


def all_of(*inputs: Formula | str) -> GateOperation:
    """Return the AND of formulas or names."""
    return GateOperation("and", _formulas(inputs))


def any_of(*inputs: Formula | str) -> GateOperation:
    """Return the OR of formulas or names."""
    return GateOperation("or", _formulas(inputs))


def at_least(count: int, *inputs: Formula | str) -> GateOperation:
    """Return a formula that is true when ``count`` or more of the inputs are."""
    return GateOperation("atleast", _formulas(inputs), count)


def none_of(formula: Formula | str) -> GateOperation:
    """Return the NOT of a formula or name."""
    return GateOperation("not", _formulas((formula,)))


def parts(formula: Formula) -> Iterator[Formula]:
    """Yield a formula and all formulas inside it, without going through names."""
    waiting = [formula]
    while waiting:
        part = waiting.pop()
        yield part
        if isinstance(part, GateOperation):
            waiting += reversed(part.inputs)


def names(formula: Formula) -> list[str]:
    """Return the names in a formula, in order, each once."""
    found = (part.name for part in parts(formula) if isinstance(part, Name))
    return list(dict.fromkeys(found))


def _formulas(inputs: tuple[Formula | str, ...]) -> tuple[Formula, ...]:
    return tuple(Name(part) if isinstance(part, str) else part for part in inputs)


# A year: what other tools for Open-PSA files take when no mission time is given
DEFAULT_MISSION_TIME_H = 8760.0

_NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Gate:
    """A named formula; ``label`` is its name for people."""

    name: str
    formula: Formula
    label: str = ""


@dataclass(frozen=True, slots=True)
class BasicEvent:
    """Something that happens or not, of itself.

    ``probability`` is None where unknown. ``expression`` is how a file writes it
    when it is not just a number.
    """

    name: str
    probability: float | None = None
    label: str = ""
    expression: Expression | None = None


@dataclass(frozen=True, slots=True)
class MefParameter:
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
    parameters: Mapping[str, MefParameter] = field(default_factory=dict)
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


@dataclass(frozen=True, slots=True)
class DefinitionLines:
    """File and line of each name of a tree."""

    file: str = "fault tree"
    places: Mapping[str, tuple[str, int]] = field(default_factory=dict)

    def problem(self, name: str, what: str, hint: str = "") -> Problem:
        """Return something about an element."""
        file, line = self.places.get(name, (self.file, 1))
        return Problem(file, line, name, what, hint)


NOWHERE = DefinitionLines()


def problems(tree: FaultTree, places: DefinitionLines = NOWHERE) -> list[Problem]:
    """Return everything for which a tree cannot be analysed."""
    found = [*_of_gates(tree, places), *_of_events(tree, places)]
    if tree.top not in tree.gates:
        hint = did_you_mean(tree.top, tree.gates).removeprefix("; ")
        found.append(places.problem(tree.top, "there is no such gate to be the top", hint))
    path = cycle(tree.gates)
    if path:
        what = f"the gate depends on itself: {' > '.join(path)}"
        found.append(places.problem(path[0], what, "take one of these inputs out"))
    return found


def _of_gates(tree: FaultTree, places: DefinitionLines) -> Iterator[Problem]:
    known = {*tree.gates, *tree.events, *tree.houses}
    for gate in tree.gates.values():
        for name in names(gate.formula):
            if name not in known:
                similar = did_you_mean(name, known).removeprefix("; ")
                yield places.problem(gate.name, f"'{name}' is not defined", similar)
        for part in parts(gate.formula):
            what = operation_problem(part) if isinstance(part, GateOperation) else ""
            if what:
                yield places.problem(gate.name, what)


def operation_problem(operation: GateOperation) -> str:
    """Return the problem with an operator and its inputs; empty if it is valid."""
    kind, size = operation.operator, len(operation.inputs)
    if size == 0:
        return f"'{kind}' has no input"
    wrong = count_problem(kind, size, *ARITY[kind])
    if wrong:
        return wrong
    if kind in ("atleast", "cardinality") and not 0 <= operation.at_least <= size:
        return f"'{kind}' asks for {operation.at_least} of {size} inputs"
    if kind == "cardinality" and operation.at_most < operation.at_least:
        return f"'{kind}' asks for at least {operation.at_least}, at most {operation.at_most}"
    return ""


def _of_events(tree: FaultTree, places: DefinitionLines) -> Iterator[Problem]:
    for event in tree.events.values():
        chance = event.probability
        if chance is not None and not 0.0 <= chance <= 1.0:
            yield places.problem(event.name, f"the probability {chance:g} is not between 0 and 1")
    for name in tree.gates:
        if name in tree.events or name in tree.houses:
            yield places.problem(name, "this is the name of a gate and of an event")


def cycle(gates: Mapping[str, Gate]) -> list[str]:
    """Return the path of gates from one back to itself; empty if there is none."""
    return path_back({name: names(gate.formula) for name, gate in gates.items()})


def path_back(uses: Mapping[str, list[str]]) -> list[str]:
    """Return a path that leads from a name back to itself; empty if there is none."""
    finished: set[str] = set()
    for start in uses:
        path: dict[str, Iterator[str]] = {}
        following: str | None = start
        while following is not None or path:
            if following in path:
                steps = list(path)
                return [*steps[steps.index(following) :], following]
            if following is not None and following in uses and following not in finished:
                path[following] = iter(uses[following])
            following = _next(path, finished)
    return []


def _next(path: dict[str, Iterator[str]], finished: set[str]) -> str | None:
    """Return the next name of a path; drop names that lead to no further ones."""
    if not path:
        return None
    last = next(reversed(path))
    following = next(path[last], None)
    if following is None:
        finished.add(last)
        del path[last]
    return following
