"""Write a program so that SWI-Prolog loads it as it is."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.diagnosis.rules.calls import called_terms
from amberbox.diagnosis.rules.clauses import Clause, Predicate
from amberbox.diagnosis.rules.intervals import HELPERS
from amberbox.diagnosis.rules.program import Program
from amberbox.diagnosis.rules.reader import read_goal
from amberbox.diagnosis.rules.terms import Key, Term, Text, Var, args_of, deref, make
from amberbox.diagnosis.rules.unify import build
from amberbox.diagnosis.rules.vocabulary import VOCABULARY
from amberbox.diagnosis.rules.writer import atom, write


def export(program: Program, goal: str = "") -> str:
    """Return facts and rules with the declarations that SWI-Prolog needs.

    What lookups find is written out as facts, as far as they can tell: of conditions those that
    the rules and ``goal`` name. Other lookups are declared as empty. Raises what lookups raise.
    """
    lines = [*_declarations(program), "", *_clauses(program), *_found(program, goal)]
    return "\n".join(lines) + "\n"


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


def _found(program: Program, goal: str) -> Iterator[str]:
    """Write what lookups find."""
    written = False
    for predicate in program.predicates.values():
        clauses = predicate.virtual.clauses if predicate.virtual is not None else None
        if clauses is not None:
            yield from clauses(_firsts(program, predicate, goal))
            written = True
    yield from HELPERS if written else ()


def _firsts(program: Program, of: Predicate, goal: str) -> list[Term]:
    """Return the values that calls of a predicate have as their first argument, each once."""
    bodies = [part for p in program.predicates.values() for c in p.clauses for part in c.goals]
    if goal:
        bodies.append(read_goal(goal).term)
    calls = (term for body in bodies for key, term in called_terms(body) if key == of.key)
    firsts = (deref(args_of(term)[0]) for term in calls)
    return list(dict.fromkeys(f for f in firsts if isinstance(f, str | Text)))
