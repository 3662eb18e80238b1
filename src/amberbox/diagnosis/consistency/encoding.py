"""Models of components as clauses: modes and values at instants, and faults between them.

Modes at an instant follow from those before it: by a fault, or by a transition whose condition
held at the instant before, or they stay. Conditions read the values of that instant, the commands
of the step included.

Source: Kurien, Nayak, Back to the future for consistency-based trajectory tracking, AAAI 2000.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeAlias

from amberbox.diagnosis.consistency.components import Components, Excluded, Guard, Step, Value
from amberbox.diagnosis.consistency.integers import Equality, Equation, IntegerSolver, Net

ModeLiterals: TypeAlias = Mapping[str, Mapping[str, int]]  # by component and mode
NetLiterals: TypeAlias = Mapping[Net, Mapping[Value | None, int]]  # by net and value
State: TypeAlias = tuple[str, ...]  # modes in the order of the model's components


@dataclass(frozen=True, slots=True)
class Start:
    """A state before the first step that is looked at, and the faults that led to it.

    ``faults`` are the steps in which each happened, counted from 1.
    """

    modes: Mapping[str, str]
    faults: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    rank: int = 0


@dataclass(frozen=True, slots=True)
class Instant:
    """Literals of the modes and values at one time."""

    modes: ModeLiterals
    values: NetLiterals


@dataclass(frozen=True)
class Encoded:
    """A model over some steps as clauses; the first instant is the one before them."""

    instants: Sequence[Instant]
    faults: Mapping[str, int]
    """Literals by ``component=mode``: the fault happens in some step, or has before."""
    parts: Mapping[str, int]
    """Literals by component: it has some fault."""
    occurrences: Mapping[tuple[str, int], int]
    """Literals by fault and step, counted from 1; 0 is a fault before the steps."""
    starts: Sequence[int]
    """Literals of the states before the steps, in their order."""


def starts_of(model: Components) -> list[Start]:
    """Return the state that a model begins in: only modes that are known are in it."""
    return [Start(model.initial)]


def encode_steps(
    model: Components, solver: IntegerSolver, starts: Sequence[Start], steps: Sequence[Step],
    *, is_begun: bool = False, seen: Mapping[str, Value] | None = None,
) -> Encoded:  # fmt: skip
    """Add what a model says about a sequence of steps; ``seen`` was observed before them.

    Components whose mode in ``starts`` is not known are in any nominal one; or, if the robot was
    running before (``is_begun``), in any mode.
    """
    commands = [step.commands for step in steps]
    first = add_instant(solver, model, add_modes(solver, model), seen or {}, (*commands, {})[0])
    instants = [first]
    occurrences: dict[tuple[str, int], int] = {}
    for number, step in enumerate(steps, 1):
        modes = add_modes(solver, model)
        found = add_transitions(solver, model, instants[-1], modes)
        occurrences |= {(fault, number): literal for fault, literal in found.items()}
        after = add_instant(solver, model, modes, step.observe, (*commands, {})[number])
        instants.append(after)
    before = {fault: first.modes[name][mode] for fault, (name, mode) in model.faults.items()}
    if is_begun:
        occurrences |= {(fault, 0): literal for fault, literal in before.items()}
    else:
        known = set.intersection(*(set(start.modes) for start in starts))
        for fault, literal in before.items():
            if model.faults[fault][0] not in known:
                solver.add([-literal])
    chosen = [solver.variable() for _ in starts]
    solver.add(chosen)
    for literal, start in zip(chosen, starts, strict=True):
        for name, mode in start.modes.items():
            solver.add([-literal, first.modes[name][mode]])
    for one, other in combinations(chosen, 2):
        solver.add([-one, -other])
    faults: dict[str, int] = {}
    for fault in model.faults:
        causes = [literal for (name, _), literal in occurrences.items() if name == fault]
        causes += [
            literal for literal, start in zip(chosen, starts, strict=True) if fault in start.faults
        ]
        faults[fault] = _any_of(solver, causes)
    return Encoded(instants, faults, add_parts(solver, model, faults), occurrences, chosen)


def add_modes(solver: IntegerSolver, model: Components) -> dict[str, dict[str, int]]:
    """Return literals of the modes of each component at one time: one of them holds."""
    modes: dict[str, dict[str, int]] = {}
    for name, kind in model.components.items():
        modes[name] = {mode: solver.variable() for mode in model.types[kind].modes}
        _exactly_one(solver, list(modes[name].values()))
    return modes


def add_parts(
    solver: IntegerSolver, model: Components, faults: Mapping[str, int]
) -> dict[str, int]:
    """Return literals by component: it has a fault; only of those that can have one."""
    of: dict[str, list[int]] = {}
    for fault, literal in faults.items():
        of.setdefault(model.faults[fault][0], []).append(literal)
    return {name: _any_of(solver, literals) for name, literals in of.items()}


def _any_of(solver: IntegerSolver, literals: Sequence[int]) -> int:
    made = solver.variable()
    solver.add([-made, *literals])
    for literal in literals:
        solver.add([made, -literal])
    return made


def _exactly_one(solver: IntegerSolver, literals: Sequence[int]) -> None:
    solver.add(literals)
    for one, other in combinations(literals, 2):
        solver.add([-one, -other])


def add_instant(
    solver: IntegerSolver,
    model: Components,
    modes: ModeLiterals,
    observed: Mapping[str, Value],
    commands: Mapping[str, Value] | None,
) -> Instant:
    """Add what a model says of the ports at one time, given the commands of the next step.

    Ports of commands have any value if ``commands`` is None.
    """
    values = _values(solver, model)
    known: dict[Net, int] = {}
    for name, value in observed.items():
        net = model.nets[name]
        if net in values:
            solver.add([values[net][value]])
        elif known.setdefault(net, int(value)) != value:
            solver.add([])
    if commands is not None:
        for literal in command_literals(model, values, observed, commands):
            solver.add([literal])
    solver.add_equations(known, _add_constraints(solver, model, modes, values))
    return Instant(modes, values)


def _add_constraints(
    solver: IntegerSolver, model: Components, modes: ModeLiterals, values: NetLiterals
) -> list[Equation]:
    """Add the constraints of each mode; return those that are equations of integers."""
    equations: list[Equation] = []
    for name, kind in model.components.items():
        nets = {port: model.nets[f"{name}.{port}"] for port in model.types[kind].ports}
        for mode, literal in modes[name].items():
            for constraint in model.constraints[kind, mode]:
                if isinstance(constraint, Equality):
                    own = {port: nets[port] for port in constraint.ports}
                    equations.append(Equation(constraint, own, literal))
                    continue
                for clause in _clauses(constraint, nets, values):
                    solver.add([-literal, *clause])
    return equations


def command_literals(
    model: Components,
    values: NetLiterals,
    observed: Mapping[str, Value],
    commands: Mapping[str, Value],
) -> Iterator[int]:
    """Yield literals of the commands of a step: all others are not given."""
    given = {model.nets[name]: value for name, value in commands.items()}
    for net, value in given.items():
        yield values[net][value]
    seen = {model.nets[name] for name in observed}
    for net in model.commanded - given.keys() - seen:
        yield values[net][model.idle(net)]


def _values(solver: IntegerSolver, model: Components) -> NetLiterals:
    """Return a literal for each value of the nets that have listed values: one of them holds.

    That of None is no value, for nets of commands.
    """
    values: dict[Net, dict[Value | None, int]] = {}
    for net, domain in model.domains.items():
        if domain is not None:
            own: Sequence[Value | None] = domain
            if net in model.commanded and model.idle(net) is None:
                own = [*domain, None]
            values[net] = {value: solver.variable() for value in own}
            _exactly_one(solver, list(values[net].values()))
    return values


def _clauses(
    constraint: Excluded, nets: Mapping[str, Net], values: NetLiterals
) -> Iterator[list[int]]:
    places = [values[nets[port]] for port in constraint.ports]
    for row in constraint.rows:
        yield [-place[value] for place, value in zip(places, row, strict=True)]


def add_transitions(
    solver: IntegerSolver, model: Components, before: Instant, modes: ModeLiterals
) -> dict[str, int]:
    """Add how the modes of one instant follow from the one before; return literals of faults."""
    occurrences: dict[str, int] = {}
    for name, kind in model.components.items():
        faulty: list[int] = []
        for mode, what in model.types[kind].modes.items():
            if not what.nominal:
                occurs = occurrences[f"{name}={mode}"] = solver.variable()
                solver.add([-occurs, modes[name][mode]])
                faulty.append(occurs)
        is_fault = _any_of(solver, faulty) if len(faulty) > 1 else (faulty or [0])[0]
        nets = {port: model.nets[f"{name}.{port}"] for port in model.types[kind].ports}
        guards = [
            _guard(solver, change.guard, nets, before.values) for change in model.changes[kind]
        ]
        for mode, literal in before.modes[name].items():
            open_: list[tuple[str, int]] = [
                (change.to, guard)
                for change, guard in zip(model.changes[kind], guards, strict=True)
                if mode in change.sources
            ]
            unless = [-literal, is_fault] if is_fault else [-literal]
            for clause in _follow(mode, open_, modes[name]):
                solver.add([*unless, *clause])
    return occurrences


def _follow(
    mode: str, open_: Sequence[tuple[str, int]], after: Mapping[str, int]
) -> Iterator[list[int]]:
    """Yield clauses for the mode that follows without a fault."""
    by_target: dict[str, list[int]] = {}
    for target, guard in open_:
        by_target.setdefault(target, []).append(guard)
    yield [after[name] for name in dict.fromkeys((mode, *by_target))]
    for target, guards in by_target.items():
        if target != mode:
            yield [-after[target], *guards]
            for guard in guards:
                yield [-after[mode], -guard, *by_target.get(mode, ())]


def _guard(
    solver: IntegerSolver, guard: Guard, nets: Mapping[str, Net], values: NetLiterals
) -> int:
    """Return a literal that holds if a condition does."""
    made = solver.variable()
    places = [values[nets[port]] for port in guard.ports]
    for row, holds in guard.rows.items():
        if all(value in place for value, place in zip(row, places, strict=True)):
            differs = [-place[value] for value, place in zip(row, places, strict=True)]
            solver.add([*differs, made if holds else -made])
    return made
