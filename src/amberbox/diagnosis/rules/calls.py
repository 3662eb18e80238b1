"""Which predicates a goal calls, also below negations, choices and findall."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from amberbox.diagnosis.rules.clauses import Predicate
from amberbox.diagnosis.rules.terms import Key, Struct, Term, deref, key_of

_GOALS: Mapping[Key, tuple[int, ...]] = {
    **{(name, 2): (0, 1) for name in (",", ";", "|", "->", "forall")},
    **{(name, 1): (0,) for name in ("\\+", "not", "once", "ignore", "call")},
    **{("findall", 3): (1,), ("findall", 4): (1,), ("aggregate_all", 3): (1,)},
}
"""Arguments that are goals."""


def called_terms(goal: Term) -> Iterator[tuple[Key, Term]]:
    """Yield the goals in a goal that call something, from left to right."""
    open_goals = [goal]
    while open_goals:
        term = deref(open_goals.pop())
        key = key_of(term)
        if key is None:
            continue
        yield key, term
        if isinstance(term, Struct):
            open_goals.extend(term.args[number] for number in reversed(_GOALS.get(key, ())))


def called(goals: Iterable[Term]) -> dict[Key, None]:
    """Return what goals call, each name once."""
    return {key: None for goal in goals for key, _ in called_terms(goal)}


def reachable(goals: Iterable[Term], known: Mapping[Key, Predicate]) -> dict[Key, None]:
    """Return everything that may be called when goals are run."""
    found = called(goals)
    open_keys = list(found)
    while open_keys:
        predicate = known.get(open_keys.pop())
        for clause in predicate.clauses if predicate is not None else ():
            for key in called(clause.goals):
                if key not in found:
                    found[key] = None
                    open_keys.append(key)
    return found
