"""Questions about a model: which faults agree with observations, and what contradicts them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from typing import Literal, TypeAlias, TypeVar

from amberbox.core.contracts import Budget, OutOfTimeError
from amberbox.core.errors import UsageError
from amberbox.diagnosis.consistency.circuits import Circuit, encode
from amberbox.diagnosis.consistency.components import Components, Excluded, Step, Value
from amberbox.diagnosis.consistency.diagnoses import (
    minimal_conflicts,
    minimal_diagnoses,
    minimal_sets,
    search_conflicts,
)
from amberbox.diagnosis.consistency.encoding import (
    Start,
    add_instant,
    add_modes,
    add_parts,
    encode_steps,
    starts_of,
)
from amberbox.diagnosis.consistency.engines import SolverName, make_solver
from amberbox.diagnosis.consistency.integers import IntegerSolver
from amberbox.diagnosis.consistency.satisfiability import Solver

T = TypeVar("T")

MOST_CLAUSES = 1_000_000

Minimal: TypeAlias = Literal["cardinality", "subset", "rank"]


@dataclass(frozen=True)
class Question:
    """A model with observations, as clauses."""

    solver: Solver
    faults: Mapping[str, int]
    """Literals by gate, or by component=mode."""
    parts: Mapping[str, int]
    """Literals by gate or component: it is faulty."""
    ranks: Mapping[str, int]
    counted: Mapping[str, int] = field(default_factory=dict)
    """Literals of faults in single steps, by any name, where time matters."""
    counted_ranks: Mapping[str, int] = field(default_factory=dict)


@dataclass
class Answer:
    """Diagnoses with their ranks, and conflicts, each sorted by size and names."""

    diagnoses: list[tuple[int, list[str]]] = field(default_factory=list)
    conflicts: list[list[str]] = field(default_factory=list)
    incomplete: str = ""

    @property
    def rank(self) -> int | None:
        """Return the least rank of a diagnosis; None without any."""
        return min((rank for rank, _ in self.diagnoses), default=None)


def of_circuit(
    circuit: Circuit,
    observations: Sequence[Mapping[str, bool]],
    budget: Budget,
    solver_name: SolverName = "",
) -> Question:
    """Return the question which gates of a circuit are faulty."""
    solver = make_solver(budget, solver_name)
    gates = {name: solver.variable() for name in circuit.gates}
    for observed in observations:
        encode(circuit, solver, gates, observed)
    return Question(solver, gates, gates, dict.fromkeys(gates, 1))


def of_components(
    model: Components,
    steps: Sequence[Step],
    budget: Budget,
    starts: Sequence[Start] = (),
    *,
    is_begun: bool = False,
    seen: Mapping[str, Value] | None = None,
    solver_name: SolverName = "",
) -> Question:
    """Return the question which faults components have; raises UsageError if it is too large.

    Where modes change with time, a fault is one that happens in some step; ``starts`` are the
    states before them, the model's own by default. ``is_begun``: the steps are not the first ones,
    so that faults may have happened before them; ``seen`` was observed just before them.
    """
    if _size(model) * (len(steps) + 1) > MOST_CLAUSES:
        raise UsageError(
            "the model is too large for so many observations",
            "ports with fewer values, constraints of fewer ports, or fewer steps make it smaller",
        )
    solver = make_solver(budget, solver_name)
    if model.is_timed:
        return _of_steps(model, starts or starts_of(model), solver, steps, seen, is_begun=is_begun)
    modes = add_modes(solver, model)
    faults = {fault: modes[name][mode] for fault, (name, mode) in model.faults.items()}
    for step in steps:
        add_instant(solver, model, modes, step.observe, {})
    ranks = {fault: model.mode(fault).rank for fault in faults}
    return Question(solver, faults, add_parts(solver, model, faults), ranks)


def _of_steps(
    model: Components, starts: Sequence[Start], solver: IntegerSolver, steps: Sequence[Step],
    seen: Mapping[str, Value] | None, *, is_begun: bool,
) -> Question:  # fmt: skip
    encoded = encode_steps(model, solver, starts, steps, is_begun=is_begun, seen=seen)
    counted = {
        f"{fault} in {number}": literal for (fault, number), literal in encoded.occurrences.items()
    }
    ranks = {
        f"{fault} in {number}": model.mode(fault).rank for fault, number in encoded.occurrences
    }
    for place, (literal, start) in enumerate(zip(encoded.starts, starts, strict=True)):
        if start.rank:
            counted[f"start {place}"], ranks[f"start {place}"] = literal, start.rank
    of_faults = {fault: model.mode(fault).rank for fault in model.faults}
    return Question(solver, encoded.faults, encoded.parts, of_faults, counted, ranks)


def _size(model: Components) -> int:
    """Return about how many clauses one observation makes."""
    rows: dict[str, int] = {}
    for (kind, _), constraints in model.constraints.items():
        made = sum(len(one.rows) if isinstance(one, Excluded) else 1 for one in constraints)
        rows[kind] = rows.get(kind, 0) + made
    for kind, changes in model.changes.items():
        rows[kind] = rows.get(kind, 0) + sum(len(change.guard.rows) for change in changes)
        rows[kind] += _pairs(len(model.types[kind].modes))
    values = sum(_pairs(len(domain)) for domain in model.domains.values() if domain)
    return values + sum(rows[kind] for kind in model.components.values())


def _pairs(count: int) -> int:
    return count * (count - 1) // 2


def ask(question: Question, minimal: Minimal, most: int, budget: Budget) -> Answer:
    """Return the minimal diagnoses, at most so many, and the minimal conflicts.

    ``cardinality`` are the diagnoses with the fewest faults, ``rank`` those with the least rank,
    both with one minimal conflict, if there is one; ``subset`` are those that contain no other,
    with all minimal conflicts.
    """
    answer = Answer()
    try:
        _find(question, minimal, most, budget, answer)
    except OutOfTimeError:
        found = f"{len(answer.diagnoses):,} diagnoses and {len(answer.conflicts):,} conflicts"
        answer.incomplete = f"time was up after {found}"
    answer.diagnoses.sort(key=lambda one: (len(one[1]), one[1]))
    answer.conflicts.sort(key=lambda one: (len(one), one))
    return answer


def _find(question: Question, minimal: Minimal, most: int, budget: Budget, answer: Answer) -> None:
    """Collect a diagnosis and a conflict by turns, so that neither takes all the time."""
    ranked = _ranked(question, minimal)
    some: Iterable[list[str] | None]
    if minimal == "subset":
        some = search_conflicts(question.solver, question.parts, budget)
    else:
        some = islice(minimal_conflicts(question.solver, question.parts, budget), 1)
    for limits in zip_longest(
        _collected(ranked, answer.diagnoses, most, "diagnoses"),
        _collected(some, answer.conflicts, most, "conflicts"),
        fillvalue="",
    ):
        answer.incomplete = answer.incomplete or "".join(limits)


def _ranked(question: Question, minimal: Minimal) -> Iterator[tuple[int, list[str]]]:
    """Yield the minimal diagnoses with their ranks; where time matters, the least of each."""
    solver, faults = question.solver, question.faults
    if minimal == "rank" and question.counted:
        least = minimal_diagnoses(
            solver, question.counted, question.counted_ranks, only_least=True, named=faults
        )
        found = [(rank, sorted(names)) for rank, names in least]
        smallest = minimal_sets([names for _, names in found])
        yield from ((rank, names) for rank, names in found if names in smallest)
        return
    ranks = None if minimal == "cardinality" else question.ranks
    for _, names in minimal_diagnoses(solver, faults, ranks, only_least=minimal != "subset"):
        rank = sum(question.ranks[name] for name in names)
        if question.counted and _counted(question) != rank:
            given = [literal if name in names else -literal for name, literal in faults.items()]
            rank, _ = next(
                minimal_diagnoses(
                    solver, question.counted, question.counted_ranks, named=faults, assumed=given
                )
            )
        yield rank, sorted(names)


def _counted(question: Question) -> int:
    """Return the rank of the faults in the solver's model, with all their steps."""
    return sum(
        question.counted_ranks[name]
        for name, literal in question.counted.items() if question.solver.holds(literal)
    )  # fmt: skip


def _collected(found: Iterable[T | None], kept: list[T], most: int, what: str) -> Iterator[str]:
    """Keep what is found, yield an empty text for each; end with the limit if there is more."""
    for one in found:
        if one is None:
            yield ""
            continue
        if len(kept) == most:
            yield f"there are more than {most:,} {what}"
            return
        kept.append(one)
        yield ""
