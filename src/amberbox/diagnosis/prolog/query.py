"""Query a program: all answers of a goal, why each holds, or why there is none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cmp_to_key
from typing import Any, Literal, TypeAlias

from amberbox.core.config import raise_errors
from amberbox.core.contracts import Budget
from amberbox.core.errors import Problem
from amberbox.diagnosis.prolog import datalog
from amberbox.diagnosis.prolog.compiler import FIXED, compile_goal
from amberbox.diagnosis.prolog.datalog import DatalogRule
from amberbox.diagnosis.prolog.machine import (
    LONGEST_GOAL,
    PrologClause,
    PrologMachine,
    PrologPredicate,
    ProofNode,
    flatten,
    nodes_of,
    unknown_predicate,
)
from amberbox.diagnosis.prolog.program import Program, SourceText, called, reachable
from amberbox.diagnosis.prolog.syntax import Sentence, read_goal, write
from amberbox.diagnosis.prolog.terms import (
    TOO_DEEP,
    Key,
    Real,
    RuleError,
    RuleFault,
    SourcePosition,
    StopFault,
    StoppedError,
    Struct,
    Term,
    TextTerm,
    Trail,
    Var,
    args_of,
    build,
    copy,
    deref,
    key_of,
    make,
    show_key,
    split_list,
    unify,
    variant,
)

_DEEPEST = 8
_MOST_TRIED = 20


@dataclass(frozen=True)
class TriedClause:
    """A clause whose head fits, the goals that held in it, and the first one that failed."""

    head: Term
    place: SourcePosition
    held: tuple[Term, ...]
    failed: FailedGoal

    def lines(self, indent: str) -> Iterator[str]:
        """Write the goal and the goals below it."""
        yield f"{indent}{write(self.head, longest=LONGEST_GOAL)}   {self.place}"
        for goal in self.held:
            yield f"{indent}  holds: {write(goal, longest=LONGEST_GOAL)}"
        yield from self.failed.lines(f"{indent}  ")


@dataclass(frozen=True)
class FailedGoal:
    """A goal that has no answer, in words, and the clauses that were tried for it."""

    goal: Term
    what: str
    tried: tuple[TriedClause, ...] = ()

    def lines(self, indent: str = "") -> Iterator[str]:
        """Write the goal and the goals below it, a line each."""
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


class FailureSearch:
    """Searches reasons why goals fail, within one budget for all of them."""

    def __init__(self, known: Mapping[Key, PrologPredicate], budget: Budget) -> None:
        self.known = known
        self.budget = budget
        self.open: set[Any] = set()

    def why_not(self, goals: Sequence[Term], depth: int = 0) -> tuple[tuple[Term, ...], FailedGoal]:
        """Return the goals that hold together from the left, and the first one that fails then."""
        held: tuple[Term, ...] = ()
        for count in range(1, len(goals) + 1):
            found = self._first(goals[:count])
            if found is None:
                # The goals before it are shown with the values they had first.
                failing = self._after(goals[: count - 1], goals[count - 1])
                return held, self._failure(failing, depth)
            held = found
        return held, FailedGoal("true", "holds")

    def _first(self, goals: Sequence[Term]) -> tuple[Term, ...] | None:
        machine = PrologMachine(self.known, self.budget)
        body: Term = "true"
        memo: dict[Var, Var] = {}
        own = [copy(goal, memo) for goal in goals]
        for goal in reversed(own):
            body = Struct(",", (goal, body))
        machine.start(compile_goal(body))
        is_true = machine.next()
        self.budget = replace(self.budget, steps=self.budget.steps - machine.steps)
        return tuple(copy(goal, None) for goal in own) if is_true else None

    def _after(self, goals: Sequence[Term], failing: Term) -> Term:
        """Return a goal with the values that the goals before it give it first."""
        keep = Struct("$keep", (failing,))
        bound = self._first([*goals, Struct("=", (keep, keep))])
        last = bound[-1] if bound else Struct("=", (keep, keep))
        kept = args_of(last)[0]
        return args_of(kept)[0]

    def _failure(self, goal: Term, depth: int) -> FailedGoal:
        key = key_of(goal)
        predicate = self.known.get(key) if key is not None else None
        if key is None or predicate is None or predicate.origin == "library":
            return FailedGoal(goal, "is not the case" if depth or key else "is no goal")
        if predicate.virtual is not None:
            return FailedGoal(goal, "nothing of the kind is found")
        if not predicate.clauses:
            return FailedGoal(goal, f"there is nothing about {show_key(key)}")
        instances = list(self._instances(predicate, goal))
        count = len(predicate.clauses)
        if not instances:
            which = "the one clause does not fit" if count == 1 else f"none of {count} clauses fits"
            return FailedGoal(goal, which)
        call = (key, variant([goal]))
        if depth >= _DEEPEST or call in self.open:
            return FailedGoal(goal, "as above" if call in self.open else "for reasons further down")
        self.open.add(call)
        tried = tuple(self._tried(*instance, depth) for instance in instances[:_MOST_TRIED])
        self.open.discard(call)
        left_out = len(instances) - len(tried)
        return FailedGoal(goal, f"and {left_out} more clauses" if left_out else "", tried)

    def _instances(
        self, predicate: PrologPredicate, goal: Term
    ) -> Iterable[tuple[PrologClause, Term, list[Term]]]:
        for clause in predicate.select(args_of(goal)):
            env: list[Term] = [Var() for _ in range(clause.size)]
            trail: Trail = []
            head = [build(pattern, env) for pattern in clause.head]
            args = args_of(copy(goal, {}))
            if all(unify(part, arg, trail) for part, arg in zip(head, args, strict=True)):
                goals = [g for part in clause.goals for g in flatten(build(part, env))]
                yield clause, copy(make(predicate.key[0], head), None), goals

    def _tried(
        self, clause: PrologClause, head: Term, goals: list[Term], depth: int
    ) -> TriedClause:
        held, failure = self.why_not(goals, depth + 1)
        return TriedClause(head, clause.place, held, failure)


# The values of the goal's variables; empty for a goal without variables that is true
Answer: TypeAlias = Mapping[str, Term]


@dataclass(frozen=True)
class Answers:
    """All answers, each once, with their proofs, or the reasons why there is none."""

    answers: tuple[Answer, ...]
    # For each answer the goals that hold, with what they follow from
    proof: tuple[tuple[ProofNode, ...], ...] = ()
    failed: tuple[FailedGoal, ...] = ()
    steps: int = 0

    def to_json(self) -> dict[str, Any]:
        """Return plain Python for programs."""
        return {
            "answers": [{k: python_value(v) for k, v in answer.items()} for answer in self.answers],
            "proof": [[node.to_json() for node in nodes] for nodes in self.proof],
            "failed": [failure.to_json() for failure in self.failed],
        }


_ANSWERS_DEEPEST = 100


def python_value(term: Term, depth: int = 0) -> Any:
    """Turn a term into plain Python: atoms and texts are strings, structures are written.

    So are lists nested more than 100 deep.
    """
    term = deref(term)
    if isinstance(term, str | int):
        return [] if term == "[]" else term
    if isinstance(term, Real):
        return float(term)
    if isinstance(term, TextTerm):
        return term.value
    items, tail = split_list(term)
    if items and tail == "[]" and depth < _ANSWERS_DEEPEST:
        return [python_value(item, depth + 1) for item in items]
    return None if isinstance(term, Var) else write(term)


def answer_text(answer: Answer) -> str:
    """Write an answer as one line: ``X = m1, Y = 3``, or yes."""
    return ", ".join(f"{k} = {write(v, most=699)}" for k, v in answer.items()) or "yes"


Want: TypeAlias = Literal["why", "why_not"] | None

_STOPPED = "allow more steps or time; a rule may call itself without end (:- table p/2.)"
_FIRST_TRY = 2_000


def ask(
    program: Program, goal_text: str, budget: Budget | None = None, want: Want = None
) -> Answers:
    """Return all answers of a goal, each once.

    ``want`` requests the proof of each answer, or the failed goals when there is none. Raises
    RuleError for an invalid goal, ConfigurationError when its rules call unknown predicates,
    StoppedError (with the answers found) when the budget is used up.
    """
    sentence = _read(goal_text)
    _refuse_unknown(sentence, program)
    question = _Question(program, sentence, budget or Budget(), want)
    try:
        return question.answers()
    except StopFault as fault:
        raise StoppedError(str(fault), _STOPPED, tuple(question.found)) from fault
    except RecursionError as error:
        raise RuleError(*TOO_DEEP) from error
    except RuleFault as fault:
        raise RuleError(fault.what, fault.hint) from fault


class _Question:
    """A goal with the answers found so far."""

    def __init__(self, program: Program, sentence: Sentence, budget: Budget, want: Want) -> None:
        self.program = program
        self.sentence = sentence
        self.budget = budget
        self.want = want
        self.found: list[Answer] = []
        self.proofs: list[tuple[ProofNode, ...]] = []
        self.names = {n: v for n, v in sentence.names.items() if n[0] != "_"}

    def answers(self) -> Answers:
        """Answer from left to right, or from the facts upwards where that is the same."""
        query = datalog.query_of(self.program.database, self.sentence.term, self.names)
        steps = None
        if query is not None:
            steps = None if datalog.is_open(query) else self._first_try()
            steps = self._from_facts(query) if steps is None else steps
        if steps is None:
            steps = self._top_down(self.budget)
        failed: tuple[FailedGoal, ...] = ()
        if self.want == "why_not" and not self.found:
            inquiry = FailureSearch(self.program.known, self.budget)
            failed = (inquiry.why_not(list(flatten(self.sentence.term)))[1],)
        proofs = tuple(self.proofs) if self.want == "why" else ()
        return Answers(tuple(self.found), proofs, failed, steps)

    def _first_try(self) -> int | None:
        """Answer a question that takes few steps; None if it takes more."""
        few = replace(self.budget, steps=min(_FIRST_TRY, self.budget.steps))
        try:
            steps = self._top_down(few)
        except (StopFault, RuleError):
            return None
        order = sorted(range(len(self.found)), key=cmp_to_key(self._compare))
        self.found = [self.found[number] for number in order]
        self.proofs = [self.proofs[number] for number in order] if self.proofs else []
        return steps

    def _compare(self, left: int, right: int) -> int:
        rows = (list(self.found[number].values()) for number in (left, right))
        return datalog.compare_rows(*rows)

    def _from_facts(self, query: DatalogRule) -> int | None:
        made = datalog.datalog_answers(
            self.program.database, query, self.budget, proving=self.want == "why"
        )
        if made is None:
            return None
        rows, steps = made
        self.found = [dict(zip(self.names, row, strict=True)) for row, _ in rows]
        self.proofs = [proof for _, proof in rows]
        return steps

    def _top_down(self, budget: Budget) -> int:
        self.found.clear()
        self.proofs.clear()
        machine = PrologMachine(self.program.known, budget, proving=self.want == "why")
        own: dict[Var, Var] = {}  # the goal itself stays as it is for another try
        machine.start(compile_goal(copy(self.sentence.term, own)))
        names = {n: own.get(v, v) for n, v in self.names.items()}
        known = set()
        while machine.next():
            key = variant(names.values())
            if key not in known:
                known.add(key)
                memo: dict[Var, Var] = {}
                self.found.append({n: copy(v, memo) for n, v in names.items()})
                if machine.proving:
                    self.proofs.append(tuple(nodes_of(machine.trace)))
        return machine.steps


def _read(goal_text: str) -> Sentence:
    try:
        sentence = read_goal(goal_text)
        compile_goal(sentence.term)
    except RuleFault as fault:
        place = SourceText("goal", goal_text)
        at = place.place(max(fault.at, 0))
        what = f"goal, column {at.column}: {fault.what}{place.picture(at)}"
        raise RuleError(what, fault.hint) from fault
    except RecursionError as error:
        raise RuleError(*TOO_DEEP) from error
    return sentence


def _refuse_unknown(sentence: Sentence, program: Program) -> None:
    for key in called([sentence.term]):
        if key not in program.known and key not in FIXED:
            fault = unknown_predicate(key, [*program.known, *FIXED])
            raise RuleError(f"goal: {fault.what}", fault.hint)
    if program.unknown:
        behind = reachable([sentence.term], program.known)
        raise_errors([*_unknown_behind(program, behind)])


def _unknown_behind(program: Program, behind: Iterable[Key]) -> Iterable[Problem]:
    for clause, key in program.unknown:
        if clause.key in behind:
            yield program.unknown_problem(clause, key)
