"""Datalog: rules without structures, evaluated bottom-up with joins in a good order.

Relations are filled stratum by stratum, each row with the rule that gave it, so that answers can
be proved in source order.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cmp_to_key
from typing import Any, TypeAlias

from amberbox.core.contracts import Budget
from amberbox.core.cycles import cyclic_groups
from amberbox.diagnosis.prolog.builtins import TESTS
from amberbox.diagnosis.prolog.compiler import FIXED, compile_clause
from amberbox.diagnosis.prolog.machine import (
    PrologClause,
    PrologPredicate,
    ProofNode,
)
from amberbox.diagnosis.prolog.terms import (
    Env,
    Key,
    RuleFault,
    Slot,
    SourcePosition,
    StopFault,
    Struct,
    Term,
    Var,
    args_of,
    build,
    compare,
    is_atomic,
    key_of,
    make,
)

Row: TypeAlias = tuple[Term, ...]
_MOST_GOALS = 60
# Built-in tests that depend on nothing but the values of their variables
_ALLOWED = frozenset(
    {
        *((name, 2) for name in ("==", "\\==", "@<", "@=<", "@>", "@>=", "=:=", "=\\=")),
        *((name, 2) for name in ("<", "=<", ">", ">=", "=", "\\=")),
        *((name, 1) for name in ("atom", "number", "integer", "float", "atomic", "string")),
    }
)


class NotDatalogError(Exception):
    """Something needs the general solver."""


@dataclass(frozen=True, slots=True, eq=False)
class Literal:
    """A goal: a relation, its negation, or a test of values (then ``test`` is set)."""

    key: Key
    args: Row
    goal: Term  # the goal as it is shown
    negated: bool = False
    test: Any = None

    def slots(self) -> set[int]:
        """Return the variables in it."""
        return set(_slots(self.args))


@dataclass(frozen=True, slots=True, eq=False)
class DatalogRule:
    """A rule whose head and goals have only variables and plain values."""

    key: Key
    head: Row
    size: int
    relations: tuple[Literal, ...]
    conditions: tuple[Literal, ...]
    literals: tuple[Literal, ...]  # all goals in source order
    clause: PrologClause


def rule_of(clause: PrologClause) -> DatalogRule:
    """Return a clause as a Datalog rule; raise NotDatalogError if it is none."""
    if len(clause.goals) > _MOST_GOALS or not all(map(_is_flat, clause.head)):
        raise NotDatalogError
    literals = tuple(_literal(goal) for goal in clause.goals)
    relations = tuple(lit for lit in literals if not lit.negated and lit.test is None)
    conditions = tuple(lit for lit in literals if lit.negated or lit.test is not None)
    _check_bound(clause.head, literals)
    return DatalogRule(
        clause.key, clause.head, clause.size, relations, conditions, literals, clause
    )


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

    A variable that occurs only in a negation matches anything there.
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


Columns: TypeAlias = tuple[int, ...]
Index: TypeAlias = Mapping[Any, Collection[Row]]


class DatalogRelation:
    """Rows in the order in which they were added, each with its origin."""

    def __init__(self) -> None:
        self.rows: dict[Row, Any] = {}
        self._order: list[Row] = []
        self._indexes: dict[Columns, dict[Any, list[Row]]] = {}

    def add(self, row: Row, origin: Any) -> bool:
        """Add a row; False if it existed already."""
        if row in self.rows:
            return False
        self.rows[row] = origin
        self._order.append(row)
        for columns, index in self._indexes.items():
            index.setdefault(_key(row, columns), []).append(row)
        return True

    def index(self, columns: Columns) -> Index:
        """Return the rows by the values of some columns; by ``()`` for no columns.

        The value of one column is the key itself, those of several a tuple.
        """
        if not columns:
            return {(): self._order}
        found = self._indexes.get(columns)
        if found is None:
            found = self._indexes[columns] = {}
            for row in self._order:
                found.setdefault(_key(row, columns), []).append(row)
        return found

    def per_key(self, columns: Columns) -> float:
        """Return the average number of rows for given values of some columns."""
        return len(self._order) / max(1, len(self.index(columns)))


def _key(row: Row, columns: Columns) -> Any:
    return row[columns[0]] if len(columns) == 1 else tuple(row[column] for column in columns)


Relations = Mapping[Key, DatalogRelation]
Filter = Callable[[Env], bool]


@dataclass(slots=True)
class JoinStep:
    """A lookup of one relation: its bound columns, and the variables it binds."""

    index: Index
    known: tuple[Term, ...]
    binds: tuple[tuple[int, int], ...]  # column and variable
    repeats: tuple[tuple[int, int], ...]  # columns that must equal another column, by its variable
    filters: list[Filter] = field(default_factory=list)
    # All variables of the head are known before this step: one match is enough
    decides: bool = False

    def rows(self, env: Env) -> Any:
        """Return the rows that match the bound columns."""
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
class JoinPlan:
    """Steps that find the rows of a rule, after tests without variables and groups of steps that
    only must have a match."""

    before: list[Filter]
    groups: list[list[JoinStep]]
    steps: list[JoinStep]


def plan_join(
    rule: DatalogRule, relations: Relations, delta: tuple[Literal, DatalogRelation] | None = None
) -> JoinPlan:
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
    return JoinPlan(tests, made, _ordered(linked, relations, conditions, done, wanted, delta))


def _bound(group: Sequence[Literal]) -> set[int]:
    return set().union(*(literal.slots() for literal in group))


def _groups(rule: DatalogRule) -> list[list[Literal]]:
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
    delta: tuple[Literal, DatalogRelation] | None,
) -> list[JoinStep]:
    open_literals = list(literals)
    steps: list[JoinStep] = []
    while open_literals:
        if delta is not None and not steps:
            best, relation = delta
        else:
            best = min(
                open_literals, key=lambda lit: relations[lit.key].per_key(_known_columns(lit, done))
            )
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


def _known_columns(literal: Literal, done: set[int]) -> Columns:
    return tuple(
        column
        for column, arg in enumerate(literal.args)
        if not isinstance(arg, Slot) or arg.index in done
    )


def _step(literal: Literal, relation: DatalogRelation, done: set[int]) -> JoinStep:
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
    return JoinStep(relation.index(columns), known, pairs, tuple(repeats))


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
        """Return whether two values are equal."""
        return left == right


_NO_MACHINE = _NoMachine()


_EVERY = 1024
_SELDOM = 64 * _EVERY
_MOST_ROWS = 2_000_000


@dataclass
class DeductiveDatabase:
    """Relations that are filled when they are needed, and the rules that fill them."""

    known: Mapping[Key, PrologPredicate]
    relations: dict[Key, DatalogRelation] = field(default_factory=dict)
    # Rules of a predicate, None if it is not Datalog
    rules: dict[Key, list[DatalogRule] | None] = field(default_factory=dict)
    steps: int = 0
    limit: Budget = field(default_factory=Budget)

    def answer(self, query: DatalogRule, budget: Budget) -> DatalogRelation:
        """Return the rows of a rule; raise NotDatalogError or StopFault."""
        self.limit, self.steps = budget, 0
        graph, groups = self.plan(query)
        for group in groups:
            if group[0] not in self.relations:
                self._fill(group, graph)
        found = self.relations[query.key] = DatalogRelation()
        try:
            self._run(query, plan_join(query, self.relations), found, [])
        finally:
            del self.relations[query.key]
        return found

    def plan(self, query: DatalogRule) -> tuple[dict[Key, list[Key]], list[list[Key]]]:
        """Return which relation needs which, and in which order they are filled.

        Raises NotDatalogError if something behind the query needs the general solver.
        """
        graph = self._graph(query)
        groups = [group for group in cyclic_groups(graph) if group != [query.key]]
        for group in groups:
            self._refuse_loops(group, graph, query)
        return graph, groups

    def _graph(self, query: DatalogRule) -> dict[Key, list[Key]]:
        """Return which relation needs which, for all behind a query."""
        graph = {query.key: _needed([query])}
        open_keys = list(graph[query.key])
        while open_keys:
            key = open_keys.pop()
            if key not in graph:
                graph[key] = _needed(self._rules(key))
                open_keys.extend(graph[key])
        return graph

    def _rules(self, key: Key) -> list[DatalogRule]:
        if key not in self.rules:
            self.rules[key] = self._read(key)
        found = self.rules[key]
        if found is None:
            raise NotDatalogError
        return found

    def _read(self, key: Key) -> list[DatalogRule] | None:
        predicate = self.known[key]
        if predicate.virtual is not None or predicate.origin == "library":
            return None
        try:
            return [rule_of(c) for c in predicate.clauses if c.body is not None or not _is_row(c)]
        except NotDatalogError:
            return None

    def _refuse_loops(
        self, group: Sequence[Key], graph: dict[Key, list[Key]], query: DatalogRule
    ) -> None:
        """Leave loops to tabling unless all rows of a tabled relation are requested."""
        if not _is_loop(group, graph):
            return
        is_part = any(not isinstance(a, Slot) for lit in query.relations for a in lit.args)
        negates = any(
            lit.negated and lit.key in group
            for key in group
            for rule in self._rules(key)
            for lit in rule.literals
        )
        if is_part or negates or not all(self.known[key].tabled for key in group):
            raise NotDatalogError

    def _fill(self, group: Sequence[Key], graph: dict[Key, list[Key]]) -> None:
        made = {key: self._facts(self.known[key].clauses) for key in group}
        self.relations.update(made)
        try:
            rules = [rule for key in group for rule in self._rules(key)]
            if _is_loop(group, graph):
                self._to_the_end(rules, group)
            else:
                for rule in rules:
                    self._run(rule, plan_join(rule, self.relations), made[rule.key], [])
        except BaseException:
            for key in group:
                del self.relations[key]
            raise

    def _facts(self, clauses: Iterable[PrologClause]) -> DatalogRelation:
        relation = DatalogRelation()
        for clause in clauses:
            if clause.body is None and _is_row(clause):
                relation.add(clause.head, clause)
        return relation

    def _to_the_end(self, rules: Sequence[DatalogRule], group: Sequence[Key]) -> None:
        """Run rules that need each other until nothing is new: only new rows are joined."""
        new = {key: list(self.relations[key].rows) for key in group}
        for rule in rules:
            self._run(
                rule, plan_join(rule, self.relations), self.relations[rule.key], new[rule.key]
            )
        recursive = [(rule, lit) for rule in rules for lit in rule.relations if lit.key in group]
        while any(new.values()):
            deltas = {key: _relation_of(rows) for key, rows in new.items()}
            new = {key: [] for key in group}
            for rule, literal in recursive:
                made = plan_join(rule, self.relations, (literal, deltas[literal.key]))
                self._run(rule, made, self.relations[rule.key], new[rule.key])

    def _run(
        self, rule: DatalogRule, made: JoinPlan, target: DatalogRelation, new: list[Row]
    ) -> None:
        env: Env = ["" for _ in range(rule.size)]
        if not all(test(env) for test in made.before):
            return
        if all(self._search(steps, 0, env, None) for steps in made.groups):
            self._search(made.steps, 0, env, _Collector(rule, target, new))

    def _search(
        self, steps: Sequence[JoinStep], number: int, env: Env, collector: _Collector | None
    ) -> bool:
        """Search matches of all steps from one on; return whether there was any."""
        if number == len(steps):
            return collector is None or collector.add(env)
        step, found = steps[number], False
        if step.decides and collector is not None and collector.has(env):
            return True
        for row in step.rows(env):
            self.steps += 1
            if not self.steps % _EVERY:
                self._check()
            if step.fits(row, env) and self._search(steps, number + 1, env, collector):
                found = True
                if step.decides:
                    break
        return found

    def _check(self) -> None:
        if not self.steps % _SELDOM:
            rows = sum(len(relation.rows) for relation in self.relations.values())
            if rows > _MOST_ROWS:
                raise StopFault(f"stopped after {self.steps:,} steps for want of memory")
        if self.steps > self.limit.steps:
            raise StopFault(f"stopped after {self.steps:,} steps")
        if self.limit.is_over():
            raise StopFault(f"stopped after {self.steps:,} steps, the time is over")


@dataclass(slots=True)
class _Collector:
    """Takes the rows of a rule's head, with the values of all its variables."""

    rule: DatalogRule
    target: DatalogRelation
    new: list[Row]

    def row(self, env: Env) -> Row:
        return tuple(env[a.index] if isinstance(a, Slot) else a for a in self.rule.head)

    def has(self, env: Env) -> bool:
        """Return whether the row is known already."""
        return self.row(env) in self.target.rows

    def add(self, env: Env) -> bool:
        row = self.row(env)
        if self.target.add(row, (self.rule, tuple(env))):
            self.new.append(row)
        return True


def _needed(rules: Iterable[DatalogRule]) -> list[Key]:
    keys = (lit.key for rule in rules for lit in rule.literals if lit.test is None)
    return list(dict.fromkeys(keys))


def _is_row(clause: PrologClause) -> bool:
    return not clause.goals and all(map(is_atomic, clause.head))


def _is_loop(group: Sequence[Key], graph: dict[Key, list[Key]]) -> bool:
    return len(group) > 1 or group[0] in graph[group[0]]


def _relation_of(rows: Iterable[Row]) -> DatalogRelation:
    relation = DatalogRelation()
    for row in rows:
        relation.add(row, None)
    return relation


_HEAD = "$answer"

# Values of the variables with their proofs, and how many steps it took
Found: TypeAlias = "tuple[list[tuple[Row, tuple[ProofNode, ...]]], int]"


def query_of(
    database: DeductiveDatabase, goal: Term, names: Mapping[str, Var]
) -> DatalogRule | None:
    """Return a goal as a rule for the values of its variables, None if it is not Datalog."""
    head = make(_HEAD, names.values())
    place = SourcePosition("goal", 1)
    clause = compile_clause(Struct(":-", (head, goal)), place, lambda _: None, {})
    try:
        query = rule_of(clause)
        database.plan(query)
    except NotDatalogError:
        return None
    return query


def is_open(query: DatalogRule) -> bool:
    """Return whether a query gives no values: then all of its relations are wanted."""
    return all(isinstance(arg, Slot) for lit in query.relations for arg in lit.args)


def datalog_answers(
    database: DeductiveDatabase, query: DatalogRule, budget: Budget, *, proving: bool
) -> Found | None:
    """Return the answers in the standard order; None if a test cannot be made.

    Raises StopFault when the budget is used up.
    """
    try:
        found = database.answer(query, budget)
    except RuleFault:
        return None  # the general solver reports the error, with its place
    prove = _Prover(database).proof if proving else _unproved
    rows = sorted(found.rows, key=cmp_to_key(compare_rows))
    return [(row, prove(*found.rows[row])) for row in rows], database.steps


def compare_rows(left: Sequence[Term], right: Sequence[Term]) -> int:
    """Compare rows by the standard order of their values."""
    return next((sign for pair in zip(left, right, strict=True) if (sign := compare(*pair))), 0)


def _unproved(rule: DatalogRule, env: Env) -> tuple[ProofNode, ...]:
    return ()


class _Prover:
    """Builds the trees of rows from the rules that gave them; equal rows share one tree."""

    def __init__(self, database: DeductiveDatabase) -> None:
        self.relations = database.relations
        self.made: dict[tuple[Key, Row], ProofNode] = {}
        self.open: list[tuple[ProofNode, DatalogRule, Env]] = []

    def proof(self, rule: DatalogRule, env: Env) -> tuple[ProofNode, ...]:
        """Return the facts and goals that an answer follows from."""
        root = ProofNode("true", "rule")
        self.open.append((root, rule, env))
        while self.open:
            node, rule, env = self.open.pop()
            node.children.extend(self._child(literal, env) for literal in rule.literals)
        return tuple(root.children)

    def _child(self, literal: Literal, env: Env) -> ProofNode:
        if literal.negated or literal.test is not None:
            return ProofNode(
                build(literal.goal, [Var() if value == "" else value for value in env]), "builtin"
            )
        row = tuple(env[arg.index] if isinstance(arg, Slot) else arg for arg in literal.args)
        key = literal.key, row
        known = self.made.get(key)
        return known if known is not None else self._make(key)

    def _make(self, key: tuple[Key, Row]) -> ProofNode:
        (name, _), row = key
        origin = self.relations[key[0]].rows[row]
        goal = make(name, row)
        if isinstance(origin, PrologClause):
            node = ProofNode(goal, "fact", origin.place)
        else:
            rule, env = origin
            node = ProofNode(goal, "rule", rule.clause.place)
            self.open.append((node, rule, env))
        self.made[key] = node
        return node
