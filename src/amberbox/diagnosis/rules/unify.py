"""Make terms equal, copy them, compare them: what the solver does all the time."""

from __future__ import annotations

from collections.abc import Hashable, Iterable

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import (
    ENDLESS,
    LONGEST,
    Env,
    Pattern,
    Slot,
    Struct,
    Term,
    Trail,
    Var,
    deref,
)


def unify(left: Term, right: Term, trail: Trail) -> bool:
    """Make two terms equal by binding variables, without occurs check, as SWI-Prolog does.

    Bindings are added to ``trail``, also those of an attempt that fails.
    """
    open_pairs = [(left, right)]
    steps = 0
    while open_pairs:
        a, b = open_pairs.pop()
        a, b = deref(a), deref(b)
        if a is b:
            continue
        if type(a) is Var:
            a.ref = b
            trail.append(a)
        elif type(b) is Var:
            b.ref = a
            trail.append(b)
        elif isinstance(a, Struct):
            if not isinstance(b, Struct) or a.name != b.name or len(a.args) != len(b.args):
                return False
            open_pairs.extend(zip(reversed(a.args), reversed(b.args), strict=True))
            steps += 1
            if steps > LONGEST:
                raise RuleFault(ENDLESS)
        elif a != b:
            return False
    return True


def match(pattern: Term, term: Term, env: list[Term | None], trail: Trail) -> bool:
    """Unify an argument of a clause's head with an argument of a call; fills ``env``."""
    while True:
        if type(pattern) is Slot:
            known = env[pattern.index]
            if known is None:
                env[pattern.index] = term
                return True
            return unify(known, term, trail)
        term = deref(term)
        if type(term) is Var:
            term.ref = build_head(pattern, env)
            trail.append(term)
            return True
        if type(pattern) is not Pattern:
            return pattern == term or (type(pattern) is Struct and unify(pattern, term, trail))
        if not isinstance(term, Struct) or not _same_form(pattern, term):
            return False
        for inner, part in zip(pattern.args[:-1], term.args[:-1], strict=True):
            if not match(inner, part, env, trail):
                return False
        pattern, term = pattern.args[-1], term.args[-1]


def _same_form(a: Struct, b: Struct) -> bool:
    return a.name == b.name and len(a.args) == len(b.args)


def build_head(pattern: Term, env: list[Term | None]) -> Term:
    """Put variables into a pattern, new ones for slots that are still empty."""
    if type(pattern) is Slot:
        known = env[pattern.index]
        if known is None:
            known = env[pattern.index] = Var()
        return known
    if type(pattern) is not Pattern:
        return pattern
    spine: list[tuple[str, list[Term]]] = []
    while type(pattern) is Pattern:
        spine.append((pattern.name, [build_head(part, env) for part in pattern.args[:-1]]))
        pattern = pattern.args[-1]
    return _fold(spine, build_head(pattern, env))


def build(pattern: Term, env: Env) -> Term:
    """Put the variables of a clause into one of its patterns."""
    if type(pattern) is Slot:
        return env[pattern.index]
    if type(pattern) is not Pattern:
        return pattern
    spine: list[tuple[str, list[Term]]] = []
    while type(pattern) is Pattern:
        spine.append((pattern.name, [build(part, env) for part in pattern.args[:-1]]))
        pattern = pattern.args[-1]
    return _fold(spine, build(pattern, env))


def _fold(spine: list[tuple[str, list[Term]]], last: Term) -> Term:
    for name, args in reversed(spine):
        last = Struct(name, (*args, last))
    return last


Memo = dict[Var, Var]
"""Which free variable became which in a copy."""


def copy(term: Term, memo: Memo | None) -> Term:
    """Copy a term with its bindings; free variables become new ones, or stay if memo is None."""
    spine: list[tuple[str, list[Term]]] = []
    term = deref(term)
    while isinstance(term, Struct):
        spine.append((term.name, [copy(part, memo) for part in term.args[:-1]]))
        term = deref(term.args[-1])
        if len(spine) > LONGEST:
            raise RuleFault(ENDLESS)
    if memo is not None and type(term) is Var:
        term = memo.setdefault(term, Var())
    return _fold(spine, term)


Copies = dict[int, tuple[Struct, Term]]
"""Structures with their copies, by ``id``."""


def freeze(term: Term, copies: Copies) -> Term:
    """Copy a term with its bindings; what the copies have in common is copied once."""
    spine: list[tuple[Struct, list[Term]]] = []
    term = deref(term)
    while isinstance(term, Struct):
        known = copies.get(id(term))
        if known is not None:
            term = known[1]
            break
        spine.append((term, [freeze(part, copies) for part in term.args[:-1]]))
        term = deref(term.args[-1])
        if len(spine) > LONGEST:
            raise RuleFault(ENDLESS)
    for struct, parts in reversed(spine):
        term = Struct(struct.name, (*parts, term))
        copies[id(struct)] = struct, term
    return term


def free_variables(terms: Iterable[Term]) -> list[Var]:
    """Return the free variables of terms, each once, from left to right."""
    found: dict[Var, None] = {}
    open_terms = list(terms)[::-1]
    steps = 0
    while open_terms:
        term = deref(open_terms.pop())
        if type(term) is Var:
            found[term] = None
        elif isinstance(term, Struct):
            open_terms.extend(reversed(term.args))
            steps += 1
            if steps > LONGEST:
                raise RuleFault(ENDLESS)
    return list(found)


def variant(terms: Iterable[Term]) -> tuple[Hashable, ...]:
    """Return a key that is equal for terms that differ only in the names of variables."""
    numbers: dict[Var, int] = {}
    key: list[Hashable] = []
    open_terms = list(terms)[::-1]
    while open_terms:
        term = deref(open_terms.pop())
        if type(term) is Var:
            key.append((numbers.setdefault(term, len(numbers)),))
        elif isinstance(term, Struct):
            key.append((term.name, len(term.args)))
            open_terms.extend(reversed(term.args))
            if len(key) > LONGEST:
                raise RuleFault(ENDLESS)
        else:
            key.append(term)
    return tuple(key)


def undo(trail: Trail, mark: int) -> None:
    """Free the variables that were bound after a mark."""
    while len(trail) > mark:
        trail.pop().ref = None
