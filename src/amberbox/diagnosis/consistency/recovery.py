"""Recovery: the shortest sequence of commands that brings components to wanted modes or values.

A plan is found for states that the components may be in, and then tried against everything that
they may do: it counts only if the goal is then certain. No further faults are assumed, and values
from outside stay as they were observed last.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.diagnosis.consistency.components import Components, Step, Value, read_value
from amberbox.diagnosis.consistency.diagnoses import minimal_diagnoses
from amberbox.diagnosis.consistency.encoding import (
    Instant,
    State,
    add_instant,
    add_modes,
    add_transitions,
    command_literals,
)
from amberbox.diagnosis.consistency.integers import IntegerSolver, Net

MOST_COMMANDED = 10  # steps of a plan
_MOST_TRIED = 300  # plans in all

Plan: TypeAlias = "tuple[Mapping[str, Value], ...]"  # the commands of each step


@dataclass(frozen=True)
class Goal:
    """Wanted modes by component, and values by component.port."""

    modes: Mapping[str, str]
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class Recovery:
    """A plan; None for none, which is certain unless the search was ``incomplete``."""

    plan: Plan | None
    incomplete: str = ""


def read_goal(entries: Sequence[str], model: Components) -> Goal:
    """Return what ``NAME=VALUE`` of components or ports stand for; raises UsageError."""
    modes: dict[str, str] = {}
    values: dict[str, Value] = {}
    for entry in entries:
        name, equals, text = entry.partition("=")
        if not equals:
            raise UsageError(f"--reach: '{entry}' is not NAME=VALUE")
        if name in model.components:
            known = model.types[model.components[name]].modes
            if text not in known:
                near = did_you_mean(text, known)
                raise UsageError(
                    f"--reach: {name} has no mode '{text}'{near}", f"modes: {', '.join(known)}"
                )
            modes[name] = text
        elif name in model.nets:
            values[name] = read_value(text, name, model, "--reach")
            if model.domains[model.nets[name]] is None:
                raise UsageError(f"--reach: {name} is an int port: give a port with listed values")
        else:
            near = did_you_mean(name, [*model.components, *model.nets])
            raise UsageError(f"--reach: there is no component and no port '{name}'{near}")
    return Goal(modes, values)


def find_plan(
    model: Components, states: Sequence[State], last: Step, goal: Goal, budget: Budget
) -> Recovery:
    """Return the plan with the fewest steps, then commands, that is certain from all states.

    ``last`` is the step in which they were reached. Without plan if there is none of at most
    ``MOST_COMMANDED`` steps, or too many had to be tried. Raises OutOfTimeError.
    """
    tried = 0
    for length in range(MOST_COMMANDED + 1):
        search = _Search(model, states, last, goal, budget, length)
        for plan in search.plans():
            if search.is_certain(plan):
                return Recovery(plan)
            tried += 1
            if tried == _MOST_TRIED:
                why = f"none of the first {tried:,} plans that may reach the goal is certain to"
                return Recovery(None, why)
    return Recovery(None)


class _Search:
    """Plans of one length as clauses."""

    def __init__(
        self, model: Components, states: Sequence[State], last: Step, goal: Goal, budget: Budget,
        length: int,
    ) -> None:  # fmt: skip
        self._model, self._goal = model, goal
        self._solver = IntegerSolver(budget)
        self._names = {net: name for name, net in reversed([*model.nets.items()])}
        self._given: dict[tuple[int, Net, Value], int] = {}
        courses = [self._course(self._solver, state, last, length) for state in states]
        for number in range(length):
            for net in model.commanded:
                for value in model.domains[net] or ():
                    if value != model.idle(net):
                        self._share(number, net, value, [course[number] for course in courses])
        for course in courses:
            for literal in self._wanted(course[-1]):
                self._solver.add([literal])
        # another solver finds out whether something else may happen with the same commands
        self._other = IntegerSolver(budget)
        self._possible = [self._course(self._other, state, last, length) for state in states]
        self._fails = []
        for course in self._possible:
            fails = self._other.variable()
            self._other.add([-fails, *(-literal for literal in self._wanted(course[-1]))])
            self._fails.append(fails)

    def _course(
        self, solver: IntegerSolver, state: State, last: Step, length: int
    ) -> list[Instant]:
        """Return the instants of a state and the steps after it, without a fault."""
        model = self._model
        modes = add_modes(solver, model)
        for literals, mode in zip(modes.values(), state, strict=True):
            solver.add([literals[mode]])
        stays = {
            name: value for name, value in last.observe.items() if model.nets[name] in model.inputs
        }
        course = [add_instant(solver, model, modes, last.observe, None if length else {})]
        for number in range(length):
            modes = add_modes(solver, model)
            for literal in add_transitions(solver, model, course[-1], modes).values():
                solver.add([-literal])
            is_last = number == length - 1
            course.append(add_instant(solver, model, modes, stays, {} if is_last else None))
        return course

    def _share(self, number: int, net: Net, value: Value, instants: Sequence[Instant]) -> None:
        made = self._given[number, net, value] = self._solver.variable()
        for instant in instants:
            literal = instant.values[net][value]
            self._solver.add([-made, literal])
            self._solver.add([made, -literal])

    def _wanted(self, at: Instant) -> Iterator[int]:
        for name, mode in self._goal.modes.items():
            yield at.modes[name][mode]
        for name, value in self._goal.values.items():
            yield at.values[self._model.nets[name]][value]

    def plans(self) -> Iterator[Plan]:
        """Yield the plans that may reach the goal, those with the fewest commands first."""
        named = {f"{key}": literal for key, literal in self._given.items()}
        keys = dict(zip(named, self._given, strict=True))
        for _, found in minimal_diagnoses(self._solver, named, named=named):
            yield self._plan([keys[name] for name in found])

    def _plan(self, found: Sequence[tuple[int, Net, Value]]) -> Plan:
        length = len(self._possible[0]) - 1
        steps: list[dict[str, Value]] = [{} for _ in range(length)]
        for number, net, value in found:
            steps[number][self._names[net]] = value
        return tuple(steps)

    def is_certain(self, plan: Plan) -> bool:
        """Return whether nothing but the goal can follow from a plan, in each of the states."""
        for course, fails in zip(self._possible, self._fails, strict=True):
            assumed = [
                literal
                for commands, at in zip(plan, course, strict=False)
                for literal in command_literals(self._model, at.values, {}, commands)
            ]
            if not self._other.solve(assumed) or self._other.solve([*assumed, fails]):
                return False
        return True
