"""Predicates about intervals of time, such as missions: their last two arguments are from and to.

A call without times gives the intervals as they are. With both times it asks whether something
was so within ``[from, to)``: at some time, or throughout. With one of them it asks about that
instant, and gives the other end of the interval in which it lies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from amberbox.core.errors import UsageError
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.proof import Source
from amberbox.diagnosis.rules.terms import Term, Text, make, to_term
from amberbox.diagnosis.rules.virtual import Sourced, Virtual
from amberbox.diagnosis.rules.writer import atom, write

Span: TypeAlias = tuple[int, int]
"""From and to in nanoseconds; what is at ``to`` does not belong to it."""
Keys: TypeAlias = "tuple[Term | None, ...]"
"""The arguments before the times, None where there is no value yet."""


@dataclass(frozen=True, slots=True)
class Interval:
    """Something was so from an instant on up to another, which does not belong to it."""

    values: tuple[object, ...]
    from_ns: int
    to_ns: int
    source: Source


Find: TypeAlias = "Callable[[Keys, Span | None], Iterable[Interval]]"
"""Returns the intervals of some keys that meet a span, or all: joined where they touch.

What lies outside of the span may be cut off.
"""


@dataclass(frozen=True, slots=True)
class Intervals:
    """What a predicate about intervals is made of.

    ``read_time`` reads a time that is written as text. ``throughout``: with both times given it
    must have been so all the time, otherwise at some time.
    """

    name: str
    keys: int
    find: Find
    read_time: Callable[[str], int]
    throughout: bool = False
    needs: tuple[frozenset[int], ...] = ()
    hint: str = ""

    def virtual(self) -> Virtual:
        """Return the predicate."""
        rows, text = partial(_rows, self), partial(_clauses, self)
        return Virtual(self.name, self.keys + 2, rows, self.needs, self.hint, text)


def _rows(of: Intervals, args: tuple[Term | None, ...]) -> Iterator[Sourced]:
    *keys, since, until = args
    from_ns, to_ns = _time(since, of), _time(until, of)
    both = None if from_ns is None or to_ns is None else (from_ns, to_ns)
    if both is not None and both[0] > both[1]:
        return
    for found in of.find(tuple(keys), both):
        if _fits(found, from_ns, to_ns, throughout=of.throughout):
            first = found.from_ns if since is None else since
            last = found.to_ns if until is None else until
            yield Sourced((*found.values, first, last), found.source)


def _time(given: Term | None, of: Intervals) -> int | None:
    """Return a time in nanoseconds since the epoch.

    Raises RuleFault for what is none.
    """
    if given is None or isinstance(given, int):
        return given
    if isinstance(given, str | Text):
        try:
            return of.read_time(given if isinstance(given, str) else given.value)
        except UsageError as error:
            raise RuleFault(f"{of.name}: {error.what}", error.hint) from error
    hint = "times are whole numbers of nanoseconds since 1970, or texts like '2026-11-21T14:00:00Z'"
    raise RuleFault(f"{of.name}: {write(given)} is no time", hint)


def _fits(found: Interval, from_ns: int | None, to_ns: int | None, *, throughout: bool) -> bool:
    begin, end = found.from_ns, found.to_ns
    if from_ns is None:
        return to_ns is None or begin < to_ns <= end
    if to_ns is None or from_ns == to_ns:
        return begin <= from_ns < end
    if throughout:
        return begin <= from_ns and to_ns <= end
    return begin < to_ns and from_ns < end


def _clauses(of: Intervals, firsts: Iterable[Term]) -> Iterator[str]:
    """Write all intervals down as facts, with the clause that answers as the lookup does."""
    names = [f"K{number}" for number in range(1, of.keys + 1)]
    spans = f"{of.name}_span"
    listed = ", ".join((*names, "S", "E"))
    test = "'$covers'" if of.throughout else "'$meets'"
    yield f"{atom(of.name)}({', '.join((*names, 'F', 'T'))}) :-"
    yield f"    {atom(spans)}({listed}),"
    yield f"    {test}(F, T, S, E)."
    yield f":- dynamic {atom(spans)}/{of.keys + 2}."
    for found in _all(of, firsts):
        values = (*found.values, found.from_ns, found.to_ns)
        yield f"{write(make(spans, map(to_term, values)), most=999)}."


def _all(of: Intervals, firsts: Iterable[Term]) -> Iterator[Interval]:
    if not any(1 in needed for needed in of.needs):
        yield from of.find((None,) * of.keys, None)
        return
    for first in firsts:
        yield from of.find((first, *(None,) * (of.keys - 1)), None)


HELPERS: Sequence[str] = (
    "'$meets'(F, T, S, E) :- var(F), var(T), !, F = S, T = E.",
    "'$meets'(F, T, S, E) :- var(F), !, S < T, T =< E, F = S.",
    "'$meets'(F, T, S, E) :- var(T), !, S =< F, F < E, T = E.",
    "'$meets'(F, F, S, E) :- !, S =< F, F < E.",
    "'$meets'(F, T, S, E) :- F < T, S < T, F < E.",
    "'$covers'(F, T, S, E) :- ( var(F) ; var(T) ; F =:= T ), !, '$meets'(F, T, S, E).",
    "'$covers'(F, T, S, E) :- F < T, S =< F, T =< E.",
)
"""What the clauses above call, for the end of a program."""
