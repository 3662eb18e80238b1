"""The standard order of terms: variables, numbers, texts, atoms, structures."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cmp_to_key
from typing import Any

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import ENDLESS, LONGEST, Real, Struct, Term, Text, Var, deref


def compare(left: Term, right: Term) -> int:
    """Return -1, 0 or 1 as the standard order of terms says."""
    pairs = [(left, right)]
    steps = 0
    while pairs:
        a, b = pairs.pop()
        a, b = deref(a), deref(b)
        if a is b:
            continue
        if isinstance(a, Struct) and isinstance(b, Struct):
            found = _sign((len(a.args), a.name), (len(b.args), b.name))
            if not found:
                pairs.extend(zip(reversed(a.args), reversed(b.args), strict=True))
            steps += 1
            if steps > LONGEST:
                raise RuleFault(ENDLESS)
        else:
            found = _simple(a, b)
        if found:
            return found
    return 0


def in_order(terms: Iterable[Term]) -> list[Term]:
    """Sort terms by the standard order; equal ones keep their places."""
    return sorted(terms, key=cmp_to_key(compare))


def once_each(terms: Iterable[Term]) -> list[Term]:
    """Sort terms by the standard order, equal ones once."""
    found: list[Term] = []
    for term in in_order(terms):
        if not found or compare(found[-1], term):
            found.append(term)
    return found


def _rank(term: Term) -> int:
    if isinstance(term, Var):
        return 0
    if isinstance(term, int | Real):
        return 1
    if isinstance(term, Text):
        return 3
    return 4 if isinstance(term, str) else 5


def _simple(a: Term, b: Term) -> int:
    rank = _rank(a)
    if rank != _rank(b):
        return -1 if rank < _rank(b) else 1
    if isinstance(a, int | Real) and isinstance(b, int | Real):
        return _sign(_value(a), _value(b)) or _sign(isinstance(a, int), isinstance(b, int))
    if isinstance(a, Text) and isinstance(b, Text):
        return _sign(a.value, b.value)
    if isinstance(a, Var) and isinstance(b, Var):
        return _sign(id(a), id(b))  # any order that stays the same while both are alive
    return _sign(str(a), str(b))


def _value(number: int | Real) -> int | float:
    return float(number) if isinstance(number, Real) else number


def _sign(a: Any, b: Any) -> int:
    return int(a > b) - int(a < b)
