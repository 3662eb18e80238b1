"""Terms of the rule language: atoms, numbers, texts, variables and structures.

Atoms are Python's ``str`` and whole numbers its ``int``; floats are ``Real``, because 1 and 1.0
are different terms; texts between double quotes are ``Text``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias

from amberbox.diagnosis.rules.faults import RuleFault

NIL = "[]"
PAIR = "[|]"
"""Name of the structure that lists are made of, as in SWI-Prolog."""

LONGEST = 1_000_000
"""Most elements of a list, and most steps of a walk through a term that may contain itself."""

ENDLESS = f"a term contains itself or has more than {LONGEST:,} parts"
"""What is wrong with a term whose end was not reached after so many steps."""

Key: TypeAlias = tuple[str, int]
"""Name and number of arguments of a predicate or structure."""


class Var:
    """A variable; ``ref`` is what it is bound to, None while it is free."""

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


class Text:
    """A text between double quotes."""

    __slots__ = ("value",)

    def __init__(self, value: str) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return type(other) is Text and other.value == self.value

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


Term: TypeAlias = "Var | Struct | Slot | Text | Real | int | str"
Trail: TypeAlias = list[Var]
Env: TypeAlias = list[Term]
"""The variables of a clause that is in use."""


def deref(term: Term) -> Term:
    """Follow bound variables to what they stand for."""
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
    """Tell whether a term has no parts."""
    return isinstance(term, str | int | Real | Text)


def is_callable(term: Term) -> bool:
    """Tell whether a term can be a goal."""
    return isinstance(term, str | Struct)


def to_term(value: object) -> Term:
    """Turn plain Python into a term: a string is an atom, a sequence is a list.

    Raises RuleFault for what has no term.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str | int | Real | Text | Struct):
        return value
    if isinstance(value, float):
        return Real(value)
    if isinstance(value, list | tuple):
        return make_list([to_term(part) for part in value])
    raise RuleFault(f"a {type(value).__name__} is no value of a fact", "texts and numbers are")


def show_key(key: Key) -> str:
    """Write a predicate as ``name/2``."""
    return f"{key[0]}/{key[1]}"
