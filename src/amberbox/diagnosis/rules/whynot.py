"""Why a goal has no answer: what was tried, and the first goal that fails in each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.clauses import Clause, Predicate, flatten
from amberbox.diagnosis.rules.compile import compile_goal
from amberbox.diagnosis.rules.faults import Place
from amberbox.diagnosis.rules.machine import Machine
from amberbox.diagnosis.rules.proof import LONGEST_GOAL
from amberbox.diagnosis.rules.terms import (
    Key,
    Struct,
    Term,
    Trail,
    Var,
    args_of,
    key_of,
    make,
    show_key,
)
from amberbox.diagnosis.rules.unify import build, copy, unify, variant
from amberbox.diagnosis.rules.writer import write

_DEEPEST = 8
_MOST_TRIED = 20


@dataclass(frozen=True)
class Tried:
    """A clause whose head fits, the goals that held in it, and the first one that failed."""

    head: Term
    place: Place
    held: tuple[Term, ...]
    failed: Failure

    def lines(self, indent: str) -> Iterator[str]:
        """Write it with what is below."""
        yield f"{indent}{write(self.head, longest=LONGEST_GOAL)}   {self.place}"
        for goal in self.held:
            yield f"{indent}  holds: {write(goal, longest=LONGEST_GOAL)}"
        yield from self.failed.lines(f"{indent}  ")


@dataclass(frozen=True)
class Failure:
    """A goal that has no answer, in words, and the clauses that were tried for it."""

    goal: Term
    what: str
    tried: tuple[Tried, ...] = ()

    def lines(self, indent: str = "") -> Iterator[str]:
        """Write it with what is below, a line each."""
        yield f"{indent}fails: {write(self.goal, longest=LONGEST_GOAL)}   {self.what}".rstrip()
        for tried in self.tried:
            yield from tried.lines(f"{indent}  ")

    def to_json(self) -> dict[str, Any]:
        """Return it as plain Python."""
        tried = [
            {
                "head": write(entry.head, longest=LONGEST_GOAL),
                "at": str(entry.place),
                "held": [write(goal, longest=LONGEST_GOAL) for goal in entry.held],
                "failed": entry.failed.to_json(),
            }
            for entry in self.tried
        ]
        return {"goal": write(self.goal, longest=LONGEST_GOAL), "what": self.what, "tried": tried}


class Inquiry:
    """Looks for reasons, within one budget for all of them."""

    def __init__(self, known: Mapping[Key, Predicate], budget: Budget) -> None:
        self.known = known
        self.budget = budget
        self.open: set[Any] = set()

    def why_not(self, goals: Sequence[Term], depth: int = 0) -> tuple[tuple[Term, ...], Failure]:
        """Return the goals that hold together from the left, and the first one that fails then."""
        held: tuple[Term, ...] = ()
        for count in range(1, len(goals) + 1):
            found = self._first(goals[:count])
            if found is None:
                # The goals before it are shown with the values they had first.
                failing = self._after(goals[: count - 1], goals[count - 1])
                return held, self._failure(failing, depth)
            held = found
        return held, Failure("true", "holds")

    def _first(self, goals: Sequence[Term]) -> tuple[Term, ...] | None:
        machine = Machine(self.known, self.budget)
        body: Term = "true"
        memo: dict[Var, Var] = {}
        own = [copy(goal, memo) for goal in goals]
        for goal in reversed(own):
            body = Struct(",", (goal, body))
        machine.start(compile_goal(body))
        is_true = machine.next()
        self.budget = Budget(
            self.budget.steps - machine.steps, self.budget.depth, self.budget.is_over
        )
        return tuple(copy(goal, None) for goal in own) if is_true else None

    def _after(self, goals: Sequence[Term], failing: Term) -> Term:
        """Return a goal with the values that the goals before it give it first."""
        keep = Struct("$keep", (failing,))
        bound = self._first([*goals, Struct("=", (keep, keep))])
        last = bound[-1] if bound else Struct("=", (keep, keep))
        kept = args_of(last)[0]
        return args_of(kept)[0]

    def _failure(self, goal: Term, depth: int) -> Failure:
        key = key_of(goal)
        predicate = self.known.get(key) if key is not None else None
        if key is None or predicate is None or predicate.origin == "library":
            return Failure(goal, "is not the case" if depth or key else "is no goal")
        if predicate.virtual is not None:
            return Failure(goal, "nothing of the kind is found")
        if not predicate.clauses:
            return Failure(goal, f"there is nothing about {show_key(key)}")
        instances = list(self._instances(predicate, goal))
        count = len(predicate.clauses)
        if not instances:
            which = "the one clause does not fit" if count == 1 else f"none of {count} clauses fits"
            return Failure(goal, which)
        call = (key, variant([goal]))
        if depth >= _DEEPEST or call in self.open:
            return Failure(goal, "as above" if call in self.open else "for reasons further down")
        self.open.add(call)
        tried = tuple(self._tried(*instance, depth) for instance in instances[:_MOST_TRIED])
        self.open.discard(call)
        left_out = len(instances) - len(tried)
        return Failure(goal, f"and {left_out} more clauses" if left_out else "", tried)

    def _instances(
        self, predicate: Predicate, goal: Term
    ) -> Iterable[tuple[Clause, Term, list[Term]]]:
        for clause in predicate.select(args_of(goal)):
            env: list[Term] = [Var() for _ in range(clause.size)]
            trail: Trail = []
            head = [build(pattern, env) for pattern in clause.head]
            args = args_of(copy(goal, {}))
            if all(unify(part, arg, trail) for part, arg in zip(head, args, strict=True)):
                goals = [g for part in clause.goals for g in flatten(build(part, env))]
                yield clause, copy(make(predicate.key[0], head), None), goals

    def _tried(self, clause: Clause, head: Term, goals: list[Term], depth: int) -> Tried:
        held, failure = self.why_not(goals, depth + 1)
        return Tried(head, clause.place, held, failure)
