"""Models of components on a robot: their steps from its record, their conflicts for its FMEA."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget, OutOfTimeError, RecordedPast
from amberbox.core.expression import ExpressionError
from amberbox.core.types import IntArray
from amberbox.diagnosis.consistency.components import (
    Binding,
    Components,
    Step,
    Value,
    value_text,
)
from amberbox.diagnosis.consistency.diagnoses import minimal_conflicts
from amberbox.diagnosis.consistency.encoding import Start
from amberbox.diagnosis.consistency.question import Question, of_components

_LOOKS = 4  # at a value while it settles
_MOST = 50  # conflicts
_MOST_CHECKS = 500  # of a budget: the search on a robot ends at the same place each time

Series: TypeAlias = "Mapping[str, tuple[IntArray, Any]]"  # times and values by address


@dataclass(frozen=True)
class Observed:
    """The steps of a model from a record, and the time of each, nanoseconds."""

    steps: Sequence[Step]
    times_ns: Sequence[int]

    @property
    def is_empty(self) -> bool:
        """Return whether no value was known."""
        return not any(step.observe or step.commands for step in self.steps)


def history_s(model: Components) -> float:
    """Return how far back the steps of a model read a record, in seconds."""
    bindings = (*model.observe.values(), *model.commands.values())
    longest = max((of.max_age + of.value.history_ns / NS for of in bindings), default=0.0)
    return _step_count(model) * model.file.period + model.file.settle + longest


def _step_count(model: Components) -> int:
    """Return how many steps count: without changes of modes only the last one."""
    return max(1, model.history) if model.is_timed else 1


def observed_steps(model: Components, past: RecordedPast, at_ns: int) -> Observed:
    """Return the last steps up to an instant, at multiples of the period.

    A value counts if it has been the same for ``settle`` seconds, a command if it is known.
    """
    period_ns = round(model.file.period * NS)
    last_ns = at_ns // period_ns * period_ns
    times_ns = [last_ns - n * period_ns for n in reversed(range(_step_count(model)))]
    begun_ns = max((run[0] for run in past.recorded if run[0] <= at_ns), default=None)
    if begun_ns is None:
        return Observed([], [])
    times_ns = [time_ns for time_ns in times_ns if time_ns >= begun_ns]
    series = _series(model, past, (begun_ns, at_ns + 1))
    settle_ns = round(model.file.settle * NS)
    looks = [round(settle_ns * n / _LOOKS) for n in reversed(range(_LOOKS + 1))]
    every = np.array([t - back for t in times_ns for back in looks], np.int64)
    observed = {
        name: _settled(_values(model, name, of, series, every), len(looks))
        for name, of in model.observe.items()
    }
    at = np.array(times_ns, np.int64)
    commands = {name: _values(model, name, of, series, at) for name, of in model.commands.items()}
    return Observed([Step(_known(observed, n), _known(commands, n)) for n in range(len(at))],
                    times_ns)  # fmt: skip


def _known(values: Mapping[str, Sequence[Value | None]], place: int) -> dict[str, Value]:
    return {name: found for name, of in values.items() if (found := of[place]) is not None}


def _settled(values: Sequence[Value | None], count: int) -> list[Value | None]:
    """Return of each group of looks the value that all of them gave."""
    groups = [values[at : at + count] for at in range(0, len(values), count)]
    return [of[-1] if all(value == of[-1] for value in of) else None for of in groups]


def _series(model: Components, past: RecordedPast, span: tuple[int, int]) -> Series:
    reads: dict[str, dict[str, None]] = {}
    for of in (*model.observe.values(), *model.commands.values()):
        for address in of.value.addresses():
            item, _, variable = address.partition(".")
            reads.setdefault(item, {})[variable] = None
    since_ns = max(span[0], span[1] - round(history_s(model) * NS) - NS)
    series: dict[str, tuple[IntArray, Any]] = {}
    for item, variables in reads.items():
        rows = list(past.rows(item, [*variables], (since_ns, span[1])))
        times = np.array([row["received"] for row in rows], np.int64)
        for variable in variables:
            values = [_known_value(row.get(variable)) for row in rows]
            series[f"{item}.{variable}"] = np.maximum.accumulate(times), _column(values)
    return series


def _column(values: list[Any]) -> Any:
    """Return values as an array if they are plain ones of one type, for several expressions."""
    is_plain = len({type(value) for value in values}) == 1 and type(values[0]) in (bool, int, float)
    array = np.array(values) if is_plain else None
    return values if array is None or array.dtype.kind not in "bif" else array


def _known_value(value: Any) -> Any:
    """Return a value of the record; NaN is not known."""
    return None if isinstance(value, float) and value != value else value


def _values(
    model: Components, name: str, of: Binding, series: Series, times_ns: IntArray
) -> list[Value | None]:
    """Return the value of a port at some instants; None where it is not known."""
    own = {address: series[address] for address in of.value.addresses()}
    fresh = np.ones(len(times_ns), bool)
    for times, _ in own.values():
        if not len(times):
            return [None] * len(times_ns)
        place = times.searchsorted(times_ns, "right") - 1
        age_ns = times_ns - times[np.maximum(place, 0)]
        fresh &= (place >= 0) & (age_ns <= round(of.max_age * NS))
    if not fresh.any():
        return [None] * len(times_ns)
    try:
        found = of.value.evaluate_series(own, times_ns)
    except (ExpressionError, ValueError, TypeError):
        return [None] * len(times_ns)
    plain = found.tolist()  # masked entries are None
    return [
        _port_value(model, name, of, value) if is_fresh else None
        for value, is_fresh in zip(plain, fresh.tolist(), strict=True)
    ]


def _port_value(model: Components, name: str, of: Binding, result: Any) -> Value | None:
    """Return the value of a port that a result stands for; None for none of its values."""
    if result is None:
        return None
    domain = model.domains[model.nets[name]]
    is_whole = isinstance(result, float) and result.is_integer()
    text = value_text(int(result) if is_whole else result)
    if text in of.values:
        return of.values[text]
    if domain is None:
        return int(result) if is_whole or type(result) is int else None
    return {value_text(value): value for value in domain}.get(text)


def question_of(model: Components, steps: Sequence[Step], budget: Budget) -> Question:
    """Return the question about the last steps of a robot that runs already."""
    start = [Start({})]
    return of_components(model, steps, budget, start, is_begun=True, solver_name="python")


def conflicts_of(model: Components, steps: Sequence[Step]) -> tuple[list[list[str]], str]:
    """Return the conflicts of the last steps of a robot, and why there may be more.

    The search has a budget that does not depend on the computer, so that live and later answers
    are the same.
    """
    left = iter(range(_MOST_CHECKS))
    budget = Budget(is_over=lambda: next(left, None) is None)
    found: list[list[str]] = []
    try:
        question = question_of(model, steps, budget)
        for conflict in minimal_conflicts(question.solver, question.parts, budget):
            found.append(conflict)
            if len(found) == _MOST:
                return sorted(found), f"only {_MOST} are looked for"
    except OutOfTimeError:
        return sorted(found), "the search was ended"
    return sorted(found), ""


def possible_faults(model: Components, steps: Sequence[Step], names: Iterable[str]) -> list[str]:
    """Return the faults of some components that agree with the last steps, whatever else is faulty.

    All of them when the budget, which is that of ``conflicts_of``, is over.
    """
    wanted = {*names}
    faults = [fault for fault, (name, _) in model.faults.items() if name in wanted]
    if not faults:
        return []
    left = iter(range(_MOST_CHECKS))
    try:
        question = question_of(model, steps, Budget(is_over=lambda: next(left, None) is None))
        return [fault for fault in faults if question.solver.solve([question.faults[fault]])]
    except OutOfTimeError:
        return faults


def mapped(
    model: Components, faults: Iterable[str], failure_modes: Sequence[str]
) -> tuple[frozenset[str], list[str]]:
    """Return the failure modes that faults stand for, and the faults that stand for none.

    A fault ``component=mode`` stands for those that ``maps_to`` names, for it or its component;
    else for ``component#mode``; else for all of the component.
    """
    found: set[str] = set()
    unmapped: list[str] = []
    for fault in faults:
        name, mode = model.faults[fault]
        given = model.file.maps_to.get(fault, model.file.maps_to.get(name))
        of_name = [one for one in failure_modes if one.partition("#")[0] == name]
        own = [f"{name}#{mode}"] if f"{name}#{mode}" in of_name else of_name
        meant = own if given is None else [one for one in given if one in failure_modes]
        found |= {*meant}
        unmapped += [] if meant else [fault]
    return frozenset(found), unmapped


def seen_text(step: Step) -> Iterator[str]:
    """Yield what was observed and commanded in a step, as text."""
    for name, value in {**step.commands, **step.observe}.items():
        yield f"{name}={value_text(value)}"
