"""The solver: runs goals from left to right with choice points, without recursion of its own.

What is left to do is a chain of frames, what may be tried instead a stack of choices, and what
was bound a trail; so the depth of a search is limited by its budget and not by Python's stack.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.clauses import Clause, Frame, Goal, Predicate
from amberbox.diagnosis.rules.faults import TOO_DEEP, RuleError, RuleFault, StopFault
from amberbox.diagnosis.rules.proof import ENTER, EXIT, LEAF, Looked, Trace
from amberbox.diagnosis.rules.terms import Env, Key, Struct, Term, Trail, Var
from amberbox.diagnosis.rules.unify import match, undo, unify

Choice: TypeAlias = tuple[Any, ...]
"""Length of the trail, trace, a function that goes on, and its arguments."""

_EVERY = 256
_LARGE = 65_536
_MOST_BOUND = 3_000_000


class Machine:
    """Runs one goal; ``trace`` is kept only when the reasons are wanted."""

    def __init__(
        self, predicates: Mapping[Key, Predicate], budget: Budget, *, proving: bool = False
    ) -> None:
        self.predicates = predicates
        self.budget = budget
        self.proving = proving
        self.trail: Trail = []
        self.choices: list[Choice] = []
        self.trace: Trace = None
        self.steps = 0
        self.charged = 0
        self.check_at = _EVERY
        self.solved = False
        self.goal: Goal | None = None
        self.frame: Frame | None = None
        self.tables: dict[Any, Any] = {}
        self.stack: list[Any] = []
        """Tables that are being filled, outermost first."""

    def start(self, goal: Goal | None) -> None:
        """Prepare to run a chain of goals."""
        done: Frame = (_DONE, [], 0, None, 0)
        self.frame = done if goal is None else (goal, [], 0, done, 1)

    def next(self) -> bool:
        """Run to the next solution; False when there are no more.

        Raises RuleError where a goal cannot be run and StopFault when the budget is used up.
        """
        frame, self.frame = self.frame, None
        try:
            return self._run(frame)
        except RuleFault as fault:
            raise self._explained(fault) from fault
        except RecursionError as error:
            raise self._explained(RuleFault(*TOO_DEEP)) from error

    def _run(self, frame: Frame | None) -> bool:
        steps = self.steps
        check_at = self.check_at
        while True:
            steps += 1
            if steps >= check_at:
                self.check_at = check_at = steps + _EVERY
                self.steps = steps
                self._check(0 if frame is None else frame[4])
            if frame is None:
                if self.solved or not self.choices:
                    self.steps = steps
                    found, self.solved = self.solved, False
                    return found
                frame = self._retry()
                continue
            goal, env, cut, up, depth = frame
            self.goal = goal
            follows = goal.next
            after = up if follows is None else (follows, env, cut, up, depth)
            frame = goal.op(self, goal, env, cut, after)

    def _retry(self) -> Frame | None:
        mark, self.trace, go_on, *rest = self.choices.pop()
        undo(self.trail, mark)
        frame: Frame | None = go_on(self, *rest)
        return frame

    def _check(self, depth: int) -> None:
        budget = self.budget
        if self.steps > budget.steps:
            raise StopFault(f"stopped after {self.steps:,} steps")
        if depth > budget.depth:
            raise StopFault(f"stopped {depth:,} goals deep, after {self.steps:,} steps")
        if len(self.trail) + len(self.choices) > _MOST_BOUND:
            raise StopFault(f"stopped after {self.steps:,} steps for want of memory")
        if budget.is_over():
            raise StopFault(f"stopped after {self.steps:,} steps, the time is over")
        if not self.choices:
            self.trail.clear()

    def charge(self, size: int) -> None:
        """Count work on something large as steps, so that few steps cannot take for ever."""
        before = self.charged
        self.charged += size
        if self.charged > self.budget.steps:
            raise StopFault(f"stopped after {self.charged:,} steps on ever larger terms")
        if self.charged // _LARGE > before // _LARGE and self.budget.is_over():
            raise StopFault(f"stopped after {self.steps:,} steps, the time is over")

    def charge_text(self, text: str) -> str:
        """Count a text that was made as steps, one for eight characters, and return it."""
        self.charge(len(text) // 8)
        return text

    def choose(self, go_on: Callable[..., Frame | None], *rest: Any) -> None:
        """Remember that something else may be tried from here."""
        self.choices.append((len(self.trail), self.trace, go_on, *rest))

    def cut(self, height: int) -> None:
        """Forget the choices above a height."""
        del self.choices[height:]

    def unify(self, left: Term, right: Term) -> bool:
        """Make two terms equal; the bindings are undone when the search goes back."""
        return unify(left, right, self.trail)

    def predicate(self, key: Key) -> Predicate:
        """Return what a goal calls; raise RuleFault if there is nothing of that name."""
        found = self.predicates.get(key)
        if found is None:
            from amberbox.diagnosis.rules.unknown import unknown_predicate

            raise unknown_predicate(key, self.predicates)
        return found

    def call(self, predicate: Predicate, args: Sequence[Term], after: Frame) -> Frame | None:
        """Try the clauses of a predicate that may match."""
        return self._try(predicate.select(args), 0, args, after)

    def _try(
        self, clauses: Sequence[Clause], number: int, args: Sequence[Term], after: Frame
    ) -> Frame | None:
        mark, count = len(self.trail), len(clauses)
        while number < count:
            clause = clauses[number]
            number += 1
            env = self._head(clause, args)
            if env is None:
                undo(self.trail, mark)
                continue
            height = len(self.choices)
            if number < count:
                again = (mark, self.trace, Machine._try, clauses, number, args, after)
                self.choices.append(again)
            return self._enter(clause, env, args, height, after)
        return None

    def _head(self, clause: Clause, args: Sequence[Term]) -> list[Any] | None:
        env: list[Any] = [None] * clause.size
        for pattern, arg in zip(clause.head, args, strict=True):
            if not match(pattern, arg, env, self.trail):
                return None
        return env

    def _enter(
        self, clause: Clause, env: list[Any], args: Sequence[Term], height: int, after: Frame
    ) -> Frame:
        if self.proving:
            self.trace = (self.trace, ENTER, clause, tuple(args))
            after = (_EXIT, None, 0, after, after[4])
        if clause.body is None:
            return after
        for slot in clause.fresh:
            env[slot] = Var()
        return (clause.body, env, height, after, after[4] + 1)

    def each(self, solutions: Iterator[Any], goal: Goal, leaf: Term, after: Frame) -> Frame | None:
        """Go on once for every solution that an iterator makes by binding variables."""
        self.goal = goal
        mark, trace = len(self.trail), self.trace
        for source in solutions:
            # What the iterator bound since the mark is undone before it makes the next one.
            self.choices.append((mark, trace, Machine.each, solutions, goal, leaf, after))
            self.note(leaf if source is None else Looked(leaf, source))
            return after
        undo(self.trail, mark)
        return None

    def note(self, leaf: Any) -> None:
        """Remember a goal that is true without clauses, or a node of a proof."""
        if self.proving:
            self.trace = (self.trace, LEAF, leaf)

    def _explained(self, fault: RuleFault) -> RuleError:
        goal = self.goal
        where = f"{goal.place}: " if goal is not None and goal.place is not None else ""
        return RuleError(f"{where}{fault.what}", fault.hint)


def term_of(goal: Goal, args: Sequence[Term]) -> Term:
    """Return a goal as a term with its present arguments."""
    return Struct(goal.key[0], tuple(args)) if args else goal.key[0]


def _solved(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> None:
    m.solved = True


def _leave(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    m.trace = (m.trace, EXIT)
    return after


_DONE = Goal(_solved, ("$done", 0))
_EXIT = Goal(_leave, ("$exit", 0))
