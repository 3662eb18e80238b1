"""Join the relations of a rule: the most selective first, each test as soon as it can be made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.diagnosis.rules.datalog.forms import Literal, Row, Rule
from amberbox.diagnosis.rules.datalog.relations import Columns, Index, Relation
from amberbox.diagnosis.rules.terms import Env, Key, Slot, Term
from amberbox.diagnosis.rules.unify import build

Relations = Mapping[Key, Relation]
Filter = Callable[[Env], bool]


@dataclass(slots=True)
class Step:
    """Look up one relation: what is known of its columns, and which variables it binds."""

    index: Index
    known: tuple[Term, ...]
    binds: tuple[tuple[int, int], ...]
    """Column and variable."""
    repeats: tuple[tuple[int, int], ...]
    """Columns that must equal another column, by its variable."""
    filters: list[Filter] = field(default_factory=list)
    decides: bool = False
    """All variables of the head are known before this step: one match is enough."""

    def rows(self, env: Env) -> Any:
        """Return the rows that match what is known."""
        known = self.known
        if len(known) == 1:
            part = known[0]
            key: Any = env[part.index] if isinstance(part, Slot) else part
        else:
            key = tuple(env[part.index] if isinstance(part, Slot) else part for part in known)
        return self.index.get(key, ())

    def fits(self, row: Row, env: Env) -> bool:
        """Bind the variables of a row; False if it does not pass the tests."""
        for column, slot in self.binds:
            env[slot] = row[column]
        for column, slot in self.repeats:
            if env[slot] != row[column]:
                return False
        return all(test(env) for test in self.filters)


@dataclass(slots=True)
class Plan:
    """Steps that find the rows of a rule, after tests without variables and groups of steps that
    only must have a match."""

    before: list[Filter]
    groups: list[list[Step]]
    steps: list[Step]


def plan(rule: Rule, relations: Relations, delta: tuple[Literal, Relation] | None = None) -> Plan:
    """Put the goals of a rule in order; ``delta`` replaces the relation of one goal."""
    wanted = {term.index for term in rule.head if isinstance(term, Slot)}
    groups = _groups(rule)
    loose = [group for group in groups if not wanted & _bound(group)]
    linked = [literal for group in groups if wanted & _bound(group) for literal in group]
    if delta is not None and any(delta[0] in group for group in loose):
        loose, linked = [], [literal for group in groups for literal in group]
    bound = _bound(rule.relations)
    done: set[int] = set()
    before = [c for c in rule.conditions if not c.slots() & bound]
    conditions = [(c, c.slots() & bound) for c in rule.conditions if c not in before]
    made = [_ordered(group, relations, conditions, done, set(), None) for group in loose]
    tests = [_filter(condition, relations, set()) for condition in before]
    return Plan(tests, made, _ordered(linked, relations, conditions, done, wanted, delta))


def _bound(group: Sequence[Literal]) -> set[int]:
    return set().union(*(literal.slots() for literal in group))


def _groups(rule: Rule) -> list[list[Literal]]:
    """Split goals into groups that share no variables, nor a test."""
    groups: list[tuple[set[int], list[Literal]]] = []
    for literal in (*rule.relations, *rule.conditions):
        slots = literal.slots()
        touching = [group for group in groups if group[0] & slots]
        groups = [group for group in groups if not group[0] & slots]
        merged = slots.union(*(group[0] for group in touching))
        groups.append((merged, [lit for group in touching for lit in group[1]] + [literal]))
    conditions = set(map(id, rule.conditions))
    return [
        kept
        for _, literals in groups
        if (kept := [literal for literal in literals if id(literal) not in conditions])
    ]


def _ordered(
    literals: Sequence[Literal],
    relations: Relations,
    conditions: list[tuple[Literal, set[int]]],
    done: set[int],
    wanted: set[int],
    delta: tuple[Literal, Relation] | None,
) -> list[Step]:
    open_literals = list(literals)
    steps: list[Step] = []
    while open_literals:
        if delta is not None and not steps:
            best, relation = delta
        else:
            best = min(open_literals, key=lambda lit: _cost(lit, relations[lit.key], done))
            relation = relations[best.key]
        open_literals.remove(best)
        step = _step(best, relation, done)
        step.decides = wanted <= done
        done |= best.slots()
        for entry in [entry for entry in conditions if entry[1] <= done]:
            conditions.remove(entry)
            step.filters.append(_filter(entry[0], relations, done))
        steps.append(step)
    return steps


def _cost(literal: Literal, relation: Relation, done: set[int]) -> float:
    return relation.per_key(_known_columns(literal, done))


def _known_columns(literal: Literal, done: set[int]) -> Columns:
    return tuple(
        column
        for column, arg in enumerate(literal.args)
        if not isinstance(arg, Slot) or arg.index in done
    )


def _step(literal: Literal, relation: Relation, done: set[int]) -> Step:
    columns = _known_columns(literal, done)
    binds: dict[int, int] = {}
    repeats: list[tuple[int, int]] = []
    for column, arg in enumerate(literal.args):
        if column in columns or not isinstance(arg, Slot):
            continue
        if arg.index in binds:
            repeats.append((column, arg.index))
        else:
            binds[arg.index] = column
    known = tuple(literal.args[column] for column in columns)
    pairs = tuple((column, slot) for slot, column in binds.items())
    return Step(relation.index(columns), known, pairs, tuple(repeats))


def _filter(condition: Literal, relations: Relations, done: set[int]) -> Filter:
    if condition.test is not None:
        test, args = condition.test, condition.args
        return lambda env: bool(test(_NO_MACHINE, [build(arg, env) for arg in args]))
    step = _step(condition, relations[condition.key], done)

    def is_absent(env: Env) -> bool:
        own = list(env)
        return not any(step.fits(row, own) for row in step.rows(env))

    return is_absent


class _NoMachine:
    """What tests of equality need of a machine: their variables are bound, nothing is undone."""

    trail: list[Any]

    def __init__(self) -> None:
        self.trail = []

    def unify(self, left: Term, right: Term) -> bool:
        """Tell whether two values are equal."""
        return left == right


_NO_MACHINE = _NoMachine()
