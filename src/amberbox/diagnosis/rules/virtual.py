"""Predicates whose facts are looked up when they are asked for, such as a robot's record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.proof import Source
from amberbox.diagnosis.rules.terms import Key, Term, Var, deref, make, show_key, to_term
from amberbox.diagnosis.rules.unify import copy, undo
from amberbox.diagnosis.rules.writer import write

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine

Row = Sequence[object]
"""One solution: a value for every argument; strings are atoms, sequences are lists."""


class Sourced(NamedTuple):
    """A solution, and where it was found."""

    row: Row
    source: Source


Lookup: TypeAlias = "Callable[[tuple[Term | None, ...]], Iterable[Row | Sourced]]"
"""Gets the arguments of a call, None where there is no value yet, and returns rows.

It may return rows that do not match what it was given; they are left out.
"""


@dataclass(frozen=True, slots=True)
class Virtual:
    """A predicate that is a lookup.

    ``needs`` are the arguments, counted from 1, that must have a value; of several sets one is
    enough. Calls that have too few are refused with ``hint``. ``clauses`` writes down what it
    finds as Prolog that answers the same, for calls with given values of the first argument.
    """

    name: str
    arity: int
    solve: Lookup
    needs: tuple[frozenset[int], ...] = ()
    hint: str = ""
    clauses: Callable[[Iterable[Term]], Iterator[str]] | None = None

    @property
    def key(self) -> Key:
        """Return name and number of arguments."""
        return self.name, self.arity

    def solutions(self, m: Machine, args: Sequence[Term]) -> Iterator[Source | None]:
        """Bind the arguments of a call to one row after the other; yield where it was found."""
        given = tuple(_given(arg) for arg in args)
        bound = {number for number, value in enumerate(given, 1) if value is not None}
        if self.needs and not any(needed <= bound for needed in self.needs):
            raise self._unbounded(args)
        mark = len(m.trail)
        for found in self.solve(given):
            row, source = found if isinstance(found, Sourced) else (found, None)
            if len(row) != self.arity:
                raise RuleFault(f"a row for {show_key(self.key)} has {len(row)} values")
            if all(m.unify(arg, to_term(part)) for arg, part in zip(args, row, strict=True)):
                yield source
            undo(m.trail, mark)

    def _unbounded(self, args: Sequence[Term]) -> RuleFault:
        goal = write(make(self.name, args))
        wanted = " or ".join(_numbers(needed) for needed in self.needs)
        what = f"{goal} would look through everything: it needs {wanted}"
        return RuleFault(what, self.hint or "give them values, in a goal before this one")


def _given(arg: Term) -> Term | None:
    arg = deref(arg)
    return None if isinstance(arg, Var) else copy(arg, None)


def _numbers(needed: frozenset[int]) -> str:
    names = " and ".join(str(number) for number in sorted(needed))
    return f"argument{'s' if len(needed) > 1 else ''} {names}"
