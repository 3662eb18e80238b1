"""Answer a goal from the facts upwards, and prove its answers in source order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cmp_to_key
from typing import TypeAlias

from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.clauses import Clause
from amberbox.diagnosis.rules.compile import compile_clause
from amberbox.diagnosis.rules.datalog.evaluate import Database
from amberbox.diagnosis.rules.datalog.forms import Literal, NotDatalogError, Row, Rule, rule_of
from amberbox.diagnosis.rules.faults import Place, RuleFault
from amberbox.diagnosis.rules.order import compare
from amberbox.diagnosis.rules.proof import Node
from amberbox.diagnosis.rules.terms import Env, Key, Slot, Struct, Term, Var, make
from amberbox.diagnosis.rules.unify import build

_HEAD = "$answer"

Found: TypeAlias = "tuple[list[tuple[Row, tuple[Node, ...]]], int]"
"""Values of the variables with their proofs, and how many steps it took."""


def query_of(database: Database, goal: Term, names: Mapping[str, Var]) -> Rule | None:
    """Return a goal as a rule for the values of its variables, None if it is not Datalog."""
    head = make(_HEAD, names.values())
    place = Place("goal", 1)
    clause = compile_clause(Struct(":-", (head, goal)), place, lambda _: None, {})
    try:
        query = rule_of(clause)
        database.plan(query)
    except NotDatalogError:
        return None
    return query


def is_open(query: Rule) -> bool:
    """Tell whether a query gives no values: then all of its relations are wanted."""
    return all(isinstance(arg, Slot) for lit in query.relations for arg in lit.args)


def answers(database: Database, query: Rule, budget: Budget, *, proving: bool) -> Found | None:
    """Return the answers in the standard order; None if a test cannot be made.

    Raises StopFault when the budget is used up.
    """
    try:
        found = database.answer(query, budget)
    except RuleFault:
        return None  # the general solver says what is wrong, with its place
    prove = _Prover(database).proof if proving else _unproved
    rows = sorted(found.rows, key=cmp_to_key(compare_rows))
    return [(row, prove(*found.rows[row])) for row in rows], database.steps


def compare_rows(left: Sequence[Term], right: Sequence[Term]) -> int:
    """Compare rows by the standard order of their values."""
    return next((sign for pair in zip(left, right, strict=True) if (sign := compare(*pair))), 0)


def _unproved(rule: Rule, env: Env) -> tuple[Node, ...]:
    return ()


class _Prover:
    """Builds the trees of rows from the rules that gave them; equal rows share one tree."""

    def __init__(self, database: Database) -> None:
        self.relations = database.relations
        self.made: dict[tuple[Key, Row], Node] = {}
        self.open: list[tuple[Node, Rule, Env]] = []

    def proof(self, rule: Rule, env: Env) -> tuple[Node, ...]:
        """Return what an answer follows from."""
        root = Node("true", "rule")
        self.open.append((root, rule, env))
        while self.open:
            node, rule, env = self.open.pop()
            node.children.extend(self._child(literal, env) for literal in rule.literals)
        return tuple(root.children)

    def _child(self, literal: Literal, env: Env) -> Node:
        if literal.negated or literal.test is not None:
            return Node(build(literal.goal, _with_free(env)), "builtin")
        row = tuple(env[arg.index] if isinstance(arg, Slot) else arg for arg in literal.args)
        key = literal.key, row
        known = self.made.get(key)
        return known if known is not None else self._make(key)

    def _make(self, key: tuple[Key, Row]) -> Node:
        (name, _), row = key
        origin = self.relations[key[0]].rows[row]
        goal = make(name, row)
        if isinstance(origin, Clause):
            node = Node(goal, "fact", origin.place)
        else:
            rule, env = origin
            node = Node(goal, "rule", rule.clause.place)
            self.open.append((node, rule, env))
        self.made[key] = node
        return node


def _with_free(env: Iterable[Term]) -> Env:
    """Show variables that mean anything as variables."""
    return [Var() if value == "" else value for value in env]
