"""Clauses and predicates in the form that the solver runs."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from amberbox.diagnosis.rules.faults import Place
from amberbox.diagnosis.rules.terms import Env, Key, Slot, Struct, Term, Var, deref

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine
    from amberbox.diagnosis.rules.virtual import Virtual

Frame: TypeAlias = tuple["Goal", Any, int, Any, int]
"""What is left to do: goal, its variables, height to cut to, the frame after it, depth."""

Op: TypeAlias = "Callable[[Machine, Goal, Env, int, Frame], Frame | None]"
"""Runs one goal and returns what to do next, None if the goal fails."""

Origin: TypeAlias = Literal["file", "facts", "library", "vocabulary"]

_MOST_INDEXED = 4


class Goal:
    """One goal of a clause, linked to the goal after it."""

    __slots__ = ("args", "cuts", "extra", "key", "next", "op", "place")

    def __init__(
        self, op: Op, key: Key, args: tuple[Term, ...] = (), extra: Any = None,
        place: Place | None = None,
    ) -> None:  # fmt: skip
        self.op = op
        self.key = key
        self.args = args
        self.extra = extra
        self.place = place
        self.next: Goal | None = None
        self.cuts = False


@dataclass(slots=True, eq=False)
class Clause:
    """A fact or a rule: its head, its goals, and the text's own terms for showing it."""

    key: Key
    head: tuple[Term, ...]
    body: Goal | None
    size: int
    fresh: tuple[int, ...]
    """Slots that only the body uses."""
    place: Place
    goals: tuple[Term, ...] = ()
    """The body in source order, as patterns."""
    names: tuple[str, ...] = ()
    """Names of the variables by slot."""
    calls: dict[Key, Place] = field(default_factory=dict)
    """Where the body calls what."""


@dataclass(slots=True, eq=False)
class Predicate:
    """All clauses of one name and number of arguments."""

    key: Key
    clauses: list[Clause] = field(default_factory=list)
    origin: Origin = "file"
    tabled: bool = False
    virtual: Virtual | None = None
    indexes: dict[int, _Index | None] = field(default_factory=dict)

    def add(self, clause: Clause) -> None:
        """Append a clause; the indexes are made again when they are needed."""
        self.clauses.append(clause)
        self.indexes.clear()

    def with_clauses(self, clauses: Sequence[Clause]) -> Predicate:
        """Return a predicate with more clauses at its end."""
        return Predicate(
            self.key, [*self.clauses, *clauses], self.origin, self.tabled, self.virtual
        )

    def select(self, args: Sequence[Term]) -> Sequence[Clause]:
        """Return the clauses that may match a call, in source order."""
        best: Sequence[Clause] = self.clauses
        if len(best) < 2:
            return best
        for place, arg in enumerate(args[:_MOST_INDEXED]):
            arg = deref(arg)
            if type(arg) is Var:
                continue
            index = self.indexes[place] if place in self.indexes else self._make_index(place)
            if index is not None:
                found = index.entries.get(index_key(arg), index.others)
                if len(found) < len(best):
                    best = found
                    if len(best) < 2:
                        break
        return best

    def _make_index(self, place: int) -> _Index | None:
        made = self.indexes[place] = _index(self.clauses, place)
        return made


@dataclass(slots=True)
class _Index:
    """Clauses by the value of one argument; ``others`` match every value."""

    entries: dict[Hashable, list[Clause]]
    others: list[Clause]


def index_key(term: Term) -> Hashable:
    """Return what two terms have in common if they may be equal."""
    return (term.name, len(term.args)) if isinstance(term, Struct) else term


def _index(clauses: Sequence[Clause], place: int) -> _Index | None:
    patterns = [clause.head[place] for clause in clauses]
    if all(type(pattern) is Slot for pattern in patterns):
        return None
    index = _Index({}, [])
    for pattern, clause in zip(patterns, clauses, strict=True):
        if type(pattern) is Slot:
            index.others.append(clause)
            for entry in index.entries.values():
                entry.append(clause)
        else:
            entry = index.entries.setdefault(index_key(pattern), list(index.others))
            entry.append(clause)
    return index


def chain(goals: Sequence[Goal]) -> Goal | None:
    """Link goals to each other and return the first one; None for no goals."""
    first: Goal | None = None
    for goal in reversed(goals):
        goal.next = first
        goal.cuts = goal.cuts or (first is not None and first.cuts)
        first = goal
    return first


def flatten(term: Term) -> Iterator[Term]:
    """Yield the goals of a conjunction from left to right."""
    term = deref(term)
    while isinstance(term, Struct) and term.name == "," and len(term.args) == 2:
        yield from flatten(term.args[0])
        term = deref(term.args[1])
    if term != "true":
        yield term
