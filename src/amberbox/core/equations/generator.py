"""Residual generators: the equations of a set solved one after the other, the last one compared.

A set with one equation more than unknowns has redundancy one: all but one of its equations compute
the unknowns, in an order in which each uses what is computed already, and the one that is left is
compared. Equations that need each other (an algebraic loop) are named, not solved.

Source: Krysander, Frisk, Leakage fault detection in electric vehicles using sequential residual
generation, IFAC 2009; Svärd, Nyberg, Residual generators for fault diagnosis using computation
sequences with mixed causality, IEEE Transactions on Systems, Man and Cybernetics A 40 (2010).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.core.clock import NS
from amberbox.core.equations.matching import Matching
from amberbox.core.equations.model_file import Equation, EquationModel, ResidualOptions
from amberbox.core.equations.structure import mask_of
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.expression import Expression


class NoResidualError(UsageError):
    """A set of equations of which no residual can be computed."""


@dataclass(frozen=True, slots=True)
class Solved:
    """A variable computed from others by an expression."""

    name: str
    equation: str
    expression: Expression


@dataclass(frozen=True, slots=True)
class Differentiated:
    """The derivative of a variable: that of a parabola fitted to ``window_ns`` around it."""

    name: str
    equation: str
    state: str
    window_ns: int


@dataclass(frozen=True, slots=True)
class Integrated:
    """A variable whose derivative is integrated over the last ``over_ns``, from ``initial`` on.

    ``leak`` (per second) is how fast it is pulled to ``initial`` meanwhile.
    """

    name: str
    equation: str
    derivative: str
    over_ns: int
    initial: Expression
    leak: float


Step: TypeAlias = Solved | Differentiated | Integrated


@dataclass(frozen=True, slots=True)
class ResidualGenerator:
    """What computes a residual: recorded variables, steps in their order, and the comparison.

    ``lead_ns`` is the delay: a residual at a time uses samples up to so much later, and ``back_ns``
    is how far before it. ``faults`` and ``components`` are those of its equations: while all of
    them are sound it stays near 0. ``compared`` is 0 while the equation ``checks`` holds.
    """

    name: str
    options: ResidualOptions
    equations: Sequence[str]
    recorded: Mapping[str, Expression]
    steps: Sequence[Step]
    checks: str
    compared: Expression | Differentiated | Integrated
    faults: Sequence[str]
    components: Sequence[str]
    lead_ns: int
    back_ns: int

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the recorded addresses that it reads, each once."""
        found = (name for one in self.recorded.values() for name in one.addresses())
        return tuple(dict.fromkeys(found))

    @property
    def clock(self) -> str:
        """Return the address that sets the times; empty for the slowest one."""
        return self.recorded[self.options.clock].addresses()[0] if self.options.clock else ""

    @property
    def window_ns(self) -> int:
        """Return how far back samples are needed for the size at an instant."""
        windows_ns = round((self.options.over_s + self.options.max_age_s) * NS)
        return self.lead_ns + self.back_ns + windows_ns

    @property
    def history_ns(self) -> int:
        """Return how far back samples are needed for what is concluded at an instant."""
        return self.window_ns + round(self.options.persistence_s * NS)


def generator_of(model: EquationModel, name: str) -> ResidualGenerator:
    """Return the generator of a residual that a model lists.

    Raises NoResidualError that says why there is none: an unknown residual, a set that is not
    over-determined by one, what cannot be computed, or an algebraic loop.
    """
    if name not in model.residuals:
        near = did_you_mean(name, model.residuals)
        raise NoResidualError(f"there is no residual '{name}'{near}")
    return derived(model, name, model.residuals[name])


def derived(model: EquationModel, name: str, options: ResidualOptions) -> ResidualGenerator:
    """Return the generator of a residual with these options; raises NoResidualError."""
    chosen = list(dict.fromkeys(options.equations))
    unknowns = {n for e in chosen for n in model.equations[e].names if n in model.unknowns}
    if len(chosen) != len(unknowns) + 1:
        raise NoResidualError(
            f"{len(chosen)} equations for {len(unknowns)} unknowns: a residual has one more",
            "amberbox structure MODEL.yaml --mso lists the sets that have one more",
        )
    if options.checks and options.checks not in chosen:
        raise NoResidualError(f"checks '{options.checks}', which is none of its equations")
    failures = []
    for checks in [options.checks] if options.checks else chosen:
        try:
            return _Derivation(model, name, options, chosen, checks).generator()
        except NoResidualError as failure:
            failures.append(failure)
    raise failures[0]


class _Derivation:
    """One choice of the equation that is compared."""

    def __init__(
        self,
        model: EquationModel,
        name: str,
        options: ResidualOptions,
        chosen: Sequence[str],
        checks: str,
    ) -> None:
        self._model, self._name, self._options = model, name, options
        self._chosen, self._checks = chosen, checks
        self._steps: list[Step] = []
        self._computed: set[str] = set()
        self._recorded: dict[str, Expression] = {}

    def generator(self) -> ResidualGenerator:
        left = self._solve([name for name in self._chosen if name != self._checks])
        if left:
            raise NoResidualError(self._unsolved(left))
        compared = self._compared(self._model.equations[self._checks])
        self._compute_terms()
        read = [*self._model.equations[self._checks].reads, *self._options.reads]
        for step in self._steps:
            read += self._model.equations[step.equation].reads
        self._recorded = self._recorded_of(read)
        if self._options.clock and self._options.clock not in self._recorded:
            raise NoResidualError(f"its clock '{self._options.clock}' is not read")
        lead_ns, back_ns = self._reach(compared)
        equations = [self._model.equations[name] for name in self._chosen]
        faults = dict.fromkeys(fault for one in equations for fault in one.faults)
        components = dict.fromkeys(one.component for one in equations if one.component)
        return ResidualGenerator(
            self._name, self._options, tuple(self._chosen), self._recorded, tuple(self._steps),
            self._checks, compared, tuple(faults), tuple(components), lead_ns, back_ns,
        )  # fmt: skip

    def _compute_terms(self) -> None:
        """Compute what ``when``, ``per`` and ``beside`` read, by other equations where needed."""
        wanted = [n for n in self._options.reads if n in self._model.unknowns]
        missing = {*wanted} - self._computed
        if missing:
            before = len(self._steps)
            self._solve([name for name in self._model.equations if name not in self._chosen])
            self._steps[before:] = _needed(self._steps[before:], missing)
            self._computed = {step.name for step in self._steps}
        for name in wanted:
            if name not in self._computed:
                raise NoResidualError(f"no equation computes '{name}', which it reads")

    def _solve(self, names: Sequence[str]) -> list[str]:
        """Compute unknowns as long as an equation has a single open one; return what is left."""
        left = list(names)
        while True:
            for name in left:
                step = self._step(name)
                if step is not None:
                    self._steps.append(step)
                    self._computed.add(step.name)
                    left.remove(name)
                    break
            else:
                return left

    def _step(self, name: str) -> Step | None:
        equation = self._model.equations[name]
        unknown = [n for n in equation.names if n in self._model.unknowns]
        missing = [n for n in unknown if n not in self._computed]
        return _given(name, equation, missing[0]) if len(missing) == 1 else None

    def _compared(self, own: Equation) -> Expression | Differentiated | Integrated:
        if own.residual is not None:
            return own.residual
        name = own.derivative if own.window_s else own.state
        step = _given(self._checks, own, name) if own.derivative else None
        if step is not None and not isinstance(step, Solved):
            return step
        for solved, expression in own.solve.items():
            return Expression.from_text(f"{_quoted(solved)} - ({expression.text})")
        raise NoResidualError(
            f"nothing compares the equation '{self._checks}'",
            "give it residual:, or solve:; one of a derivative window_s:, or over_s:",
        )

    def _unsolved(self, left: Sequence[str]) -> str:
        """Return why equations are not solved: nothing computes an unknown, or a loop."""
        unknowns = list(self._model.unknowns)
        edges = [
            mask_of(
                unknowns.index(n)
                for n in self._model.equations[name].names
                if n in unknowns
                and n not in self._computed
                and _given(name, self._model.equations[name], n) is not None
            )
            for name in left
        ]
        matching = Matching.of(edges, (1 << len(left)) - 1, len(unknowns))
        open_ = {n for e in left for n in self._model.equations[e].names if n in unknowns}
        idle = sorted(n for n in open_ - self._computed if matching.owner[unknowns.index(n)] < 0)
        if idle:
            by = " or ".join(e for e in left if idle[0] in self._model.equations[e].names)
            return f"nothing computes '{idle[0]}': give solve: {{{idle[0]}: ...}} to {by}"
        return f"an algebraic loop is not solved: {', '.join(self._loop(left, matching, unknowns))}"

    def _loop(
        self, left: Sequence[str], matching: Matching, unknowns: Sequence[str]
    ) -> Iterator[str]:
        """Yield a loop of equations, each of which needs what the one after it computes."""
        owner = {unknowns[n]: left[e] for n, e in enumerate(matching.owner) if e >= 0}
        way: list[str] = [left[0]]
        while way[-1] not in way[:-1]:
            mine = {n for n, e in owner.items() if e == way[-1]}
            names = self._model.equations[way[-1]].names
            needed = (n for n in names if n in owner and n not in mine)
            way.append(owner[next(needed)])
        yield from way[way.index(way[-1]) : -1]

    def _recorded_of(self, names: Iterable[str]) -> dict[str, Expression]:
        """Return what is recorded of the known ones among variables."""
        known = [n for n in dict.fromkeys(names) if n in self._model.known]
        for name in known:
            if name not in self._model.recorded:
                raise NoResidualError(
                    f"what is recorded of '{name}' is not stated",
                    f"known: {{{name}: ITEM.VARIABLE}}, or an expression of several",
                )
        return {name: self._model.recorded[name] for name in known}

    def _reach(self, compared: Expression | Differentiated | Integrated) -> tuple[int, int]:
        """Return how far after and before a time its residual uses samples, ns."""
        lead = dict.fromkeys(self._recorded, 0)
        back = dict(lead)
        for step in self._steps:
            lead[step.name], back[step.name] = _reach_of(step, lead, back)
        read = (*self._options.reads, *self._model.equations[self._checks].names)
        leads, backs = [lead[n] for n in read], [back[n] for n in read]
        if not isinstance(compared, Expression):
            own_lead, own_back = _reach_of(compared, lead, back)
            leads, backs = [*leads, own_lead], [*backs, own_back]
        return max(leads, default=0), max(backs, default=0)


def _given(name: str, equation: Equation, unknown: str) -> Step | None:
    """Return the step by which an equation gives a variable; None if it cannot."""
    if unknown in equation.solve:
        return Solved(unknown, name, equation.solve[unknown])
    if equation.derivative and unknown == equation.derivative and equation.window_s:
        return Differentiated(unknown, name, equation.state, round(equation.window_s * NS))
    if equation.derivative and unknown == equation.state and equation.initial is not None:
        over_ns = round(equation.over_s * NS)
        return Integrated(
            unknown, name, equation.derivative, over_ns, equation.initial, equation.leak
        )
    return None


def _reach_of(step: Step, lead: Mapping[str, int], back: Mapping[str, int]) -> tuple[int, int]:
    if isinstance(step, Solved):
        names = step.expression.addresses()
        return (max((lead[n] for n in names), default=0), max((back[n] for n in names), default=0))
    if isinstance(step, Differentiated):
        half_ns = -(-step.window_ns // 2)
        return lead[step.state] + half_ns, back[step.state] + half_ns
    return lead[step.derivative], back[step.derivative] + step.over_ns


def _needed(steps: Sequence[Step], wanted: Collection[str]) -> list[Step]:
    """Return those of the steps that wanted variables need."""
    needed, kept = set(wanted), list[Step]()
    for step in reversed(steps):
        if step.name in needed:
            kept.append(step)
            needed |= _inputs(step)
    return kept[::-1]


def _inputs(step: Step) -> set[str]:
    if isinstance(step, Solved):
        return {*step.expression.addresses()}
    return {step.state if isinstance(step, Differentiated) else step.derivative}


def _quoted(name: str) -> str:
    return f"`{name}`"
