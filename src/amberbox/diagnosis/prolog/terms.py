"""Terms of the rule language: atoms, numbers, texts, variables, structures; unification, order."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import cmp_to_key
from typing import Any, TypeAlias

from amberbox.core.errors import AmberboxError, UsageError

# What is wrong with a term whose parts are nested too deeply to go through, and the hint
TOO_DEEP = "a term is nested too deeply", "use lists, not f(f(f(...)))"


class RuleFault(Exception):  # noqa: N818  # not an error yet: it becomes one with its place
    """An error; ``at`` is the position in the text being read, -1 if there is none."""

    def __init__(self, what: str, hint: str = "", at: int = -1) -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint
        self.at = at


class StopFault(Exception):  # noqa: N818  # as above
    """The budget is used up."""


class RuleError(UsageError):
    """A goal that is invalid, or that ends with an error."""


class StoppedError(AmberboxError):
    """The search was ended by its budget; ``answers`` were found until then."""

    def __init__(self, what: str, hint: str, answers: Sequence[object] = ()) -> None:
        super().__init__(what, hint)
        self.answers = tuple(answers)


@dataclass(frozen=True, slots=True)
class SourcePosition:
    """A position in a file: lines and columns count from 1."""

    file: str
    line: int
    column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


NIL = "[]"
PAIR = "[|]"  # name of the structure that lists are made of, as in SWI-Prolog

# Most elements of a list, and most steps of a walk through a term that may contain itself
LONGEST = 1_000_000

# What is wrong with a term whose end was not reached after so many steps
ENDLESS = f"a term contains itself or has more than {LONGEST:,} parts"

Key: TypeAlias = tuple[str, int]  # name and number of arguments of a predicate or structure


class Var:
    """A variable; ``ref`` is the term it is bound to, None while it is free."""

    __slots__ = ("ref",)

    def __init__(self) -> None:
        self.ref: Term | None = None


class Slot:
    """Place of a variable in a clause that is not in use yet."""

    __slots__ = ("index",)

    def __init__(self, index: int) -> None:
        self.index = index


class Struct:
    """A name with arguments."""

    __slots__ = ("args", "name")

    def __init__(self, name: str, args: tuple[Term, ...]) -> None:
        self.name = name
        self.args = args


class Pattern(Struct):
    """A structure of a clause that contains slots."""

    __slots__ = ()


class TextTerm:
    """A text between double quotes."""

    __slots__ = ("value",)

    def __init__(self, value: str) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return type(other) is TextTerm and other.value == self.value

    def __hash__(self) -> int:
        return hash(("text", self.value))


class Real(float):
    """A float that is never equal to a whole number, nor 0.0 to -0.0."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if type(other) is not Real:
            return False
        same_sign = math.copysign(1, self) == math.copysign(1, other)
        return float.__eq__(self, other) is True and same_sign

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(("real", float(self)))


Term: TypeAlias = "Var | Struct | Slot | TextTerm | Real | int | str"
Trail: TypeAlias = list[Var]
Env: TypeAlias = list[Term]  # the variables of a clause that is in use


def deref(term: Term) -> Term:
    """Follow bound variables to their values."""
    while type(term) is Var:
        ref = term.ref
        if ref is None:
            return term
        term = ref
    return term


def make_list(items: Sequence[Term], tail: Term = NIL) -> Term:
    """Make a list of the items."""
    for item in reversed(items):
        tail = Struct(PAIR, (item, tail))
    return tail


def split_list(term: Term) -> tuple[list[Term], Term]:
    """Return the elements of a list and what follows them, ``[]`` if it is a proper list."""
    items: list[Term] = []
    term = deref(term)
    while isinstance(term, Struct) and term.name == PAIR and len(term.args) == 2:
        items.append(term.args[0])
        if len(items) > LONGEST:
            raise RuleFault(f"a list contains itself or has more than {LONGEST:,} elements")
        term = deref(term.args[1])
    return items, term


def key_of(term: Term) -> Key | None:
    """Return name and number of arguments of something that can be called, else None."""
    if isinstance(term, Struct):
        return term.name, len(term.args)
    return (term, 0) if isinstance(term, str) else None


def args_of(term: Term) -> tuple[Term, ...]:
    """Return the arguments of a structure, none for an atom."""
    return term.args if isinstance(term, Struct) else ()


def make(name: str, args: Iterable[Term]) -> Term:
    """Make a structure, or an atom without arguments."""
    parts = tuple(args)
    return Struct(name, parts) if parts else name


def is_atomic(term: Term) -> bool:
    """Return whether a term has no parts."""
    return isinstance(term, str | int | Real | TextTerm)


def is_callable(term: Term) -> bool:
    """Return whether a term can be a goal."""
    return isinstance(term, str | Struct)


def to_term(value: object) -> Term:
    """Turn plain Python into a term: a string is an atom, a sequence is a list.

    Raises RuleFault for a value without a term.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str | int | Real | TextTerm | Struct):
        return value
    if isinstance(value, float):
        return Real(value)
    if isinstance(value, list | tuple):
        return make_list([to_term(part) for part in value])
    raise RuleFault(f"a {type(value).__name__} is no value of a fact", "texts and numbers are")


def show_key(key: Key) -> str:
    """Write a predicate as ``name/2``."""
    return f"{key[0]}/{key[1]}"


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
        if not isinstance(term, Struct) or term.name != pattern.name:
            return False
        if len(term.args) != len(pattern.args):
            return False
        for inner, part in zip(pattern.args[:-1], term.args[:-1], strict=True):
            if not match(inner, part, env, trail):
                return False
        pattern, term = pattern.args[-1], term.args[-1]


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


Memo = dict[Var, Var]  # which free variable became which in a copy


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


Copies = dict[int, tuple[Struct, Term]]  # structures with their copies, by id


def freeze(term: Term, copies: Copies) -> Term:
    """Copy a term with its bindings; shared subterms are copied once."""
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


def compare(left: Term, right: Term) -> int:
    """Return -1, 0 or 1 by the standard order of terms."""
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
    if isinstance(term, TextTerm):
        return 3
    return 4 if isinstance(term, str) else 5


def _simple(a: Term, b: Term) -> int:
    rank = _rank(a)
    if rank != _rank(b):
        return -1 if rank < _rank(b) else 1
    if isinstance(a, int | Real) and isinstance(b, int | Real):
        return _sign(python_number(a), python_number(b)) or _sign(
            isinstance(a, int), isinstance(b, int)
        )
    if isinstance(a, TextTerm) and isinstance(b, TextTerm):
        return _sign(a.value, b.value)
    if isinstance(a, Var) and isinstance(b, Var):
        return _sign(id(a), id(b))  # any order that stays the same while both are alive
    return _sign(str(a), str(b))


def python_number(number: int | Real) -> int | float:
    """Return Python's own number, which compares by value."""
    return float(number) if isinstance(number, Real) else number


def _sign(a: Any, b: Any) -> int:
    return int(a > b) - int(a < b)
