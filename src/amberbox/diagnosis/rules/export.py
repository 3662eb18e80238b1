"""Write a program so that SWI-Prolog loads it as it is."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.diagnosis.rules.clauses import Clause
from amberbox.diagnosis.rules.program import Program
from amberbox.diagnosis.rules.terms import Key, Term, Var, make
from amberbox.diagnosis.rules.unify import build
from amberbox.diagnosis.rules.vocabulary import VOCABULARY
from amberbox.diagnosis.rules.writer import atom, write


def export(program: Program) -> str:
    """Return facts and rules with the declarations that SWI-Prolog needs.

    Lookups have no facts to export; they are declared as empty.
    """
    return "\n".join([*_declarations(program), "", *_clauses(program)]) + "\n"


def _declarations(program: Program) -> Iterator[str]:
    yield "% Facts and rules of a robot; load them with: swipl FILE"
    own = program.predicates
    tabled = [key for key, predicate in own.items() if predicate.tabled and predicate.clauses]
    for key in dict.fromkeys([*own, *VOCABULARY]):
        if key in tabled:
            yield f":- table {_indicator(key)}."
        elif key not in own or not own[key].clauses or own[key].origin != "file":
            yield f":- dynamic {_indicator(key)}."


def _indicator(key: Key) -> str:
    return f"{atom(key[0])}/{key[1]}"


def _clauses(program: Program) -> Iterator[str]:
    for predicate in program.predicates.values():
        for clause in predicate.clauses:
            yield clause_text(clause)


def clause_text(clause: Clause) -> str:
    """Write a clause with the names of its variables and its final dot."""
    env: list[Term] = [Var() for _ in range(clause.size)]
    labels = dict(zip(env, clause.names, strict=True))
    head = make(clause.key[0], (build(part, env) for part in clause.head))
    goals = [build(goal, env) for goal in clause.goals]
    if not goals:
        return f"{_shown(head, labels)}."
    inner = ",\n    ".join(_shown(goal, labels) for goal in goals)
    return f"{_shown(head, labels)} :-\n    {inner}."


def _shown(term: Term, labels: dict[Term, str]) -> str:
    return write(term, lambda variable: labels.get(variable, "_"), most=999)
