"""Ask a program: all answers of a goal, why each holds, or why there is none."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cmp_to_key
from typing import Literal, TypeAlias

from amberbox.core.config import refuse
from amberbox.core.errors import Problem
from amberbox.diagnosis.rules.answers import Answer, Answers
from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.calls import called, reachable
from amberbox.diagnosis.rules.clauses import flatten
from amberbox.diagnosis.rules.compile import FIXED, compile_goal
from amberbox.diagnosis.rules.datalog import question as datalog
from amberbox.diagnosis.rules.datalog.forms import Rule
from amberbox.diagnosis.rules.faults import TOO_DEEP, RuleError, RuleFault, StopFault, StoppedError
from amberbox.diagnosis.rules.machine import Machine
from amberbox.diagnosis.rules.program import Program
from amberbox.diagnosis.rules.proof import Node, nodes_of
from amberbox.diagnosis.rules.reader import Sentence, read_goal
from amberbox.diagnosis.rules.sourcetext import SourceText
from amberbox.diagnosis.rules.terms import Key, Var
from amberbox.diagnosis.rules.unify import copy, variant
from amberbox.diagnosis.rules.unknown import unknown_predicate
from amberbox.diagnosis.rules.whynot import Failure, Inquiry

Want: TypeAlias = Literal["why", "why_not"] | None

_STOPPED = "allow more steps or time; a rule may call itself without end (:- table p/2.)"
_FIRST_TRY = 2_000


def ask(
    program: Program, goal_text: str, budget: Budget | None = None, want: Want = None
) -> Answers:
    """Return all answers of a goal, each once.

    ``want`` asks for the proof of each answer, or for what failed when there is none. Raises
    RuleError for a goal that cannot be asked, ConfigurationError when the rules behind it call
    what there is not, StoppedError (with what was found) when the budget is used up.
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
    """A goal with what was found so far."""

    def __init__(self, program: Program, sentence: Sentence, budget: Budget, want: Want) -> None:
        self.program = program
        self.sentence = sentence
        self.budget = budget
        self.want = want
        self.found: list[Answer] = []
        self.proofs: list[tuple[Node, ...]] = []
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
        failed: tuple[Failure, ...] = ()
        if self.want == "why_not" and not self.found:
            inquiry = Inquiry(self.program.known, self.budget)
            failed = (inquiry.why_not(list(flatten(self.sentence.term)))[1],)
        proofs = tuple(self.proofs) if self.want == "why" else ()
        return Answers(tuple(self.found), proofs, failed, steps)

    def _first_try(self) -> int | None:
        """Answer a question that takes few steps; None if it takes more."""
        few = Budget(min(_FIRST_TRY, self.budget.steps), self.budget.depth, self.budget.is_over)
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

    def _from_facts(self, query: Rule) -> int | None:
        made = datalog.answers(
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
        machine = Machine(self.program.known, budget, proving=self.want == "why")
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
        refuse([*_unknown_behind(program, behind)])


def _unknown_behind(program: Program, behind: Iterable[Key]) -> Iterable[Problem]:
    for clause, key in program.unknown:
        if clause.key in behind:
            yield program.unknown_problem(clause, key)
