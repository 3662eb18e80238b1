"""Which clauses are Datalog: only names and numbers, and every variable is bound by a goal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from amberbox.diagnosis.rules.builtins import TESTS
from amberbox.diagnosis.rules.clauses import Clause
from amberbox.diagnosis.rules.compile import FIXED
from amberbox.diagnosis.rules.terms import Key, Slot, Struct, Term, args_of, is_atomic, key_of

Row: TypeAlias = tuple[Term, ...]
_MOST_GOALS = 60
_ALLOWED = frozenset(
    {
        *((name, 2) for name in ("==", "\\==", "@<", "@=<", "@>", "@>=", "=:=", "=\\=")),
        *((name, 2) for name in ("<", "=<", ">", ">=", "=", "\\=")),
        *((name, 1) for name in ("atom", "number", "integer", "float", "atomic", "string")),
    }
)
"""Built-in tests that depend on nothing but the values of their variables."""


class NotDatalogError(Exception):
    """Something needs the general solver."""


@dataclass(frozen=True, slots=True, eq=False)
class Literal:
    """A goal: a relation, its negation, or a test of values (then ``test`` is set)."""

    key: Key
    args: Row
    goal: Term
    """The goal as it is shown."""
    negated: bool = False
    test: Any = None

    def slots(self) -> set[int]:
        """Return the variables in it."""
        return set(_slots(self.args))


@dataclass(frozen=True, slots=True, eq=False)
class Rule:
    """A rule whose head and goals have only variables and plain values."""

    key: Key
    head: Row
    size: int
    relations: tuple[Literal, ...]
    conditions: tuple[Literal, ...]
    literals: tuple[Literal, ...]
    """All goals in source order."""
    clause: Clause


def rule_of(clause: Clause) -> Rule:
    """Return a clause as a Datalog rule; raise NotDatalogError if it is none."""
    if len(clause.goals) > _MOST_GOALS or not all(map(_is_flat, clause.head)):
        raise NotDatalogError
    literals = tuple(_literal(goal) for goal in clause.goals)
    relations = tuple(lit for lit in literals if not lit.negated and lit.test is None)
    conditions = tuple(lit for lit in literals if lit.negated or lit.test is not None)
    _check_bound(clause.head, literals)
    return Rule(clause.key, clause.head, clause.size, relations, conditions, literals, clause)


def _literal(goal: Term) -> Literal:
    key = key_of(goal)
    if key in (("\\+", 1), ("not", 1)) and isinstance(goal, Struct):
        inner = _literal(goal.args[0])
        if inner.negated or inner.test is not None:
            raise NotDatalogError
        return Literal(inner.key, inner.args, goal, negated=True)
    if key is None:
        raise NotDatalogError
    args = args_of(goal)
    if key in _ALLOWED and (key[0] not in ("=", "\\=") or all(map(_is_flat, args))):
        return Literal(key, args, goal, test=TESTS[key])
    if key in FIXED or not all(map(_is_flat, args)):
        raise NotDatalogError
    return Literal(key, args, goal)


def _is_flat(term: Term) -> bool:
    return isinstance(term, Slot) or is_atomic(term)


def _slots(terms: Sequence[Term]) -> Iterator[int]:
    for term in terms:
        if isinstance(term, Slot):
            yield term.index
        elif isinstance(term, Struct):
            yield from _slots(term.args)


def _check_bound(head: Row, literals: Sequence[Literal]) -> None:
    """Refuse a head, negation or test with a variable that no goal before it binds.

    A variable that occurs nowhere else but in a negation means anything there.
    """
    bound: set[int] = set()
    for number, literal in enumerate(literals):
        if not literal.negated and literal.test is None:
            bound |= literal.slots()
            continue
        loose = literal.slots() - bound
        others = [*literals[:number], *literals[number + 1 :]]
        elsewhere = set(_slots(head)).union(*(other.slots() for other in others))
        if loose and (literal.test is not None or loose & elsewhere):
            raise NotDatalogError
    if not set(_slots(head)) <= bound:
        raise NotDatalogError
