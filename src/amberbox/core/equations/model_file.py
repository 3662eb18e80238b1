"""Models of ``kind: equations``: which variables each equation has, and which faults break it.

Where the equations also have expressions, and the known variables are recorded, residuals can be
computed from a record (``core.equations.generator``).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Literal

from amberbox.core.config import Finding, build, raise_errors
from amberbox.core.equations.structure import Structure, mask_of
from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.core.yaml_nodes import Node, load_yaml

MOST_EQUATIONS = 2_000
LONGEST_S = 600.0
"""The longest window, so that no model asks for hours of a record at once."""


@dataclass(frozen=True)
class Equation:
    """An equation between variables, or one that says what a derivative is of."""

    variables: list[str] = option([], "the unknown and known variables in it")
    faults: list[str] = option([], "the faults because of which it does not hold")
    state: str = option("", "with derivative: the variable that it is the derivative of")
    derivative: str = option("", "a variable that is the derivative of state, and nothing else")
    component: str = option("", "the component that makes it hold as long as it is sound")
    solve: dict[str, Expression] = option({}, "variables that it gives, from its other ones")
    residual: Expression | None = option(None, "what is 0 as long as it holds, in its variables")
    window_s: float = option(
        0.0, "to differentiate state: over how long a parabola is fitted to it", unit="s"
    )
    over_s: float = option(0.0, "to integrate derivative: from how long before", unit="s")
    initial: Expression | None = option(None, "with over_s: the state where integration begins")
    leak: float = option(0.0, "with over_s: how fast the state is pulled to initial, per second")

    @property
    def names(self) -> list[str]:
        """Return its variables."""
        if self.derivative or self.state:
            return [*self.variables, *filter(None, (self.state, self.derivative))]
        return self.variables or list(dict.fromkeys(self._read()))

    @property
    def reads(self) -> list[str]:
        """Return its variables, and those that ``initial`` reads."""
        return [*self.names, *(() if self.initial is None else self.initial.addresses())]

    def _read(self) -> Iterator[str]:
        for name, expression in self.solve.items():
            yield name
            yield from expression.addresses()
        if self.residual is not None:
            yield from self.residual.addresses()

    def check(self) -> Iterator[Finding]:
        """Yield windows that cannot be, and keys that belong to other equations."""
        yield from _bad_spans(self, "window_s", "over_s")
        if not 0 <= self.leak < inf:
            yield "leak", "must be 0 or more"
        of_derivatives = ("window_s", "over_s", "initial", "leak")
        if not self.derivative:
            for key in of_derivatives:
                if getattr(self, key):
                    yield key, "belongs to an equation with state and derivative"
        elif self.solve or self.residual is not None:
            key = "solve" if self.solve else "residual"
            yield key, "is not for an equation of a derivative: it has window_s, or over_s"
        if bool(self.over_s) != (self.initial is not None):
            yield "over_s" if self.over_s else "initial", "integration needs over_s and initial"
        if self.leak and not self.over_s:
            yield "leak", "needs over_s and initial"
        yield from looking_back({**self.solve, "residual": self.residual, "initial": self.initial})


@dataclass(frozen=True)
class ResidualOptions:
    """A residual: equations of which one is checked, and when it counts as violated."""

    equations: list[str] = option(doc="one more than there are unknowns in them")
    checks: str = option("", "the equation that is compared; without, the first that can be")
    when: Expression | None = option(None, "the samples that count; all without")
    over_s: float = option(5.0, "the size is that of the samples in so long", unit="s")
    least: int = option(25, "how many samples must count in it, else nothing is concluded")
    per: Expression | None = option(
        None, "the size is how many times this the residual is (least squares); without, its mean"
    )
    beside: list[Expression] = option([], "with per: further terms, whose shares are left out")
    clock: str = option(
        "", "the known variable at whose samples it is computed; the slowest without"
    )
    max_age_s: float = option(0.5, "older samples are unknown, longer pauses a gap", unit="s")
    threshold: float | None = option(None, "a greater size is a violation; learnt by --learn")
    shown_by: str = option(
        "",
        "the output of the monitor that shows it: while it is bad, one of its components is faulty",
    )
    persistence_s: float = option(1.0, "how long the size must be greater throughout", unit="s")

    @property
    def reads(self) -> Iterator[str]:
        """Yield the variables that its expressions read."""
        for expression in (self.when, self.per, *self.beside):
            yield from () if expression is None else expression.addresses()

    def check(self) -> Iterator[Finding]:
        """Yield windows and numbers that cannot be."""
        yield from _bad_spans(self, "over_s", "max_age_s", "persistence_s")
        for key in ("over_s", "max_age_s"):
            if not getattr(self, key):
                yield key, "must be above 0"
        if not 1 <= self.least <= 1_000_000:
            yield "least", "must be 1 or more"
        if self.threshold is not None and not 0 <= self.threshold < inf:
            yield "threshold", "must be 0 or more"
        if self.beside and self.per is None:
            yield "beside", "needs per"
        if not self.equations:
            yield "equations", "there are none"
        terms = {f"beside[{place}]": term for place, term in enumerate(self.beside)}
        yield from looking_back({"when": self.when, "per": self.per, **terms})


def _bad_spans(options: object, *keys: str) -> Iterator[tuple[str, str]]:
    for key in keys:
        if not 0 <= getattr(options, key) <= LONGEST_S:
            yield key, f"must lie from 0 to {LONGEST_S:g} s"


def looking_back(expressions: Mapping[str, Expression | None]) -> Iterator[tuple[str, str]]:
    """Yield expressions that need a past: residuals have windows of their own."""
    for key, expression in expressions.items():
        if expression is not None and expression.needs_history:
            yield key, "looks back in time ('over', 'for', 'age'), which no equation can"
        elif expression is not None and expression.kind == "text":
            yield key, "is a text"


@dataclass(frozen=True)
class EquationModel:
    """The keys of a model of equations."""

    kind: Literal["equations"] = option(doc="what the model is made of")
    unknowns: list[str] = option(doc="variables that are not measured")
    equations: dict[str, Equation] = option(doc="by name")
    known: list[str] | dict[str, Expression] = option(
        [], "variables that are measured, or commanded; with what is recorded of each"
    )
    residuals: dict[str, ResidualOptions] = option({}, "residuals by name")

    @property
    def recorded(self) -> Mapping[str, Expression]:
        """Return what is recorded of known variables."""
        return self.known if isinstance(self.known, dict) else {}

    @property
    def variables(self) -> frozenset[str]:
        """Return the names of all variables."""
        return frozenset((*self.unknowns, *self.known))


def load_model(path: Path) -> EquationModel:
    """Return a model; raises ConfigurationError with everything that is wrong in the file."""
    problems: list[Problem] = []
    node = load_yaml(path, problems)
    model = None if node is None else build(EquationModel, node, problems)
    if node is not None and model is not None:
        problems += _Checks(model, node).problems()
    raise_errors(problems)
    assert model is not None
    return model


def load_equations(path: Path) -> Structure:
    """Return the structure of a model; raises ConfigurationError with all that is wrong in it."""
    return structure_of(load_model(path))


def structure_of(model: EquationModel) -> Structure:
    """Return the structure of a model without mistakes."""
    number = {name: place for place, name in enumerate(model.unknowns)}
    equations = list(model.equations.values())
    differentials = {
        place: (number[equation.state], number[equation.derivative])
        for place, equation in enumerate(equations)
        if equation.derivative
    }
    faults = {
        fault: 1 << place for place, equation in enumerate(equations) for fault in equation.faults
    }
    return Structure(
        list(model.equations),
        model.unknowns,
        list(faults),
        [mask_of(number[name] for name in e.names if name in number) for e in equations],
        list(faults.values()),
        differentials,
        [[name for name in equation.names if name not in number] for equation in equations],
    )


class _Checks:
    """What is wrong with a model beyond its keys and types."""

    def __init__(self, model: EquationModel, node: Node) -> None:
        self._model = model
        self._variables = model.variables
        assert node.mapping is not None
        self._node = node.mapping["equations"]
        self._top: Mapping[str, Node] = node.mapping

    def problems(self) -> Iterator[Problem]:
        """Yield them in the order of the file."""
        yield from self._listed_twice()
        if len(self._model.equations) > MOST_EQUATIONS:
            yield self._node.problem("equations", f"are more than {MOST_EQUATIONS:,}")
        for name, expression in self._model.recorded.items():
            place, where = _at(self._top["known"], name), f"known.{name}"
            for _, what in looking_back({name: expression}):
                yield place.problem(where, what)
        assert self._node.mapping is not None
        stands_in: dict[str, str] = {}
        for name, node in self._node.mapping.items():
            equation, where = self._model.equations[name], f"equations.{name}"
            yield from self._equation(equation, node, where)
            for fault in equation.faults:
                other = stands_in.setdefault(fault, name)
                if other != name:
                    yield node.problem(
                        where, f"has the fault '{fault}', as '{other}' has",
                        "make it an unknown of both, with an equation of its own that the fault "
                        "breaks",
                    )  # fmt: skip
        for name, residual in self._model.residuals.items():
            node = _at(self._top["residuals"], name)
            yield from self._residual(residual, node, f"residuals.{name}")

    def _listed_twice(self) -> Iterator[Problem]:
        seen: set[str] = set()
        for key in ("unknowns", "known"):
            for name in getattr(self._model, key):
                if name in seen:
                    yield self._top[key].problem(key, f"'{name}' is listed twice")
                seen.add(name)

    def _equation(self, equation: Equation, node: Node, where: str) -> Iterator[Problem]:
        yield from self._unknown_names(equation.names, self._variables, node, where)
        if equation.variables:
            for key, expression in (*equation.solve.items(), ("residual", equation.residual)):
                names = () if expression is None else expression.addresses()
                read = [n for n in names if n in self._variables]
                yield from self._unknown_names(read, equation.variables, node, f"{where}.{key}")
        for key, expression in equation.solve.items():
            if key in expression.addresses():
                yield node.problem(f"{where}.solve", f"'{key}' is computed from itself")
        if equation.initial is not None:
            names = equation.initial.addresses()
            yield from self._unknown_names(names, self._model.known, node, f"{where}.initial")
        if not equation.derivative and not equation.state:
            if not equation.names:
                yield node.problem(where, "has no variables")
            return
        if equation.variables or not (equation.state and equation.derivative):
            yield node.problem(
                where, "is no equation of a derivative",
                "such an equation has state and derivative, and no variables",
            )  # fmt: skip
        elif not {equation.state, equation.derivative} <= set(self._model.unknowns):
            what = "says what is the derivative of a known variable"
            yield node.problem(
                where, what, "add an unknown, and an equation that makes it equal to the known one"
            )

    def _residual(self, residual: ResidualOptions, node: Node, where: str) -> Iterator[Problem]:
        for name in (*residual.equations, *filter(None, [residual.checks])):
            if name not in self._model.equations:
                near = did_you_mean(name, self._model.equations)
                yield node.problem(where, f"there is no equation '{name}'{near}")
        yield from self._unknown_names(residual.reads, self._variables, node, where)
        if residual.clock:
            yield from self._unknown_names([residual.clock], self._model.known, node, where)

    def _unknown_names(
        self, names: Collection[str] | Iterator[str], known: Collection[str], node: Node, where: str
    ) -> Iterator[Problem]:
        for name in dict.fromkeys(names):
            if name in known:
                continue
            if name in self._variables:
                yield node.problem(where, f"'{name}' is none of its variables")
                continue
            what = f"there is no variable '{name}'" + did_you_mean(name, self._variables)
            yield node.problem(where, what, "list it in unknowns or in known")


def _at(node: Node, key: str) -> Node:
    return (node.mapping or {}).get(key, node)
