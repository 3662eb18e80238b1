"""Fill the relations behind a goal, group by group, each row with the rule that gave it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.diagnosis.rules.budget import Budget
from amberbox.diagnosis.rules.clauses import Clause, Predicate
from amberbox.diagnosis.rules.datalog.forms import Literal, NotDatalogError, Row, Rule, rule_of
from amberbox.diagnosis.rules.datalog.joins import Plan, Step, plan
from amberbox.diagnosis.rules.datalog.relations import Relation
from amberbox.diagnosis.rules.datalog.strata import components
from amberbox.diagnosis.rules.faults import StopFault
from amberbox.diagnosis.rules.terms import Env, Key, Slot, is_atomic

_EVERY = 1024
_SELDOM = 64 * _EVERY
_MOST_ROWS = 2_000_000


@dataclass
class Database:
    """Relations that are filled when they are needed, and the rules that fill them."""

    known: Mapping[Key, Predicate]
    relations: dict[Key, Relation] = field(default_factory=dict)
    rules: dict[Key, list[Rule] | None] = field(default_factory=dict)
    """Rules of a predicate, None if it is not Datalog."""
    steps: int = 0
    limit: Budget = field(default_factory=Budget)

    def answer(self, query: Rule, budget: Budget) -> Relation:
        """Return the rows of a rule; raise NotDatalogError or StopFault."""
        self.limit, self.steps = budget, 0
        graph, groups = self.plan(query)
        for group in groups:
            if group[0] not in self.relations:
                self._fill(group, graph)
        found = self.relations[query.key] = Relation()
        try:
            self._run(query, plan(query, self.relations), found, [])
        finally:
            del self.relations[query.key]
        return found

    def plan(self, query: Rule) -> tuple[dict[Key, list[Key]], list[list[Key]]]:
        """Return which relation needs which, and in which order they are filled.

        Raises NotDatalogError if something behind the query needs the general solver.
        """
        graph = self._graph(query)
        groups = [group for group in components(graph) if group != [query.key]]
        for group in groups:
            self._refuse_loops(group, graph, query)
        return graph, groups

    def _graph(self, query: Rule) -> dict[Key, list[Key]]:
        """Return which relation needs which, for all behind a query."""
        graph = {query.key: _needed([query])}
        open_keys = list(graph[query.key])
        while open_keys:
            key = open_keys.pop()
            if key not in graph:
                graph[key] = _needed(self._rules(key))
                open_keys.extend(graph[key])
        return graph

    def _rules(self, key: Key) -> list[Rule]:
        if key not in self.rules:
            self.rules[key] = self._read(key)
        found = self.rules[key]
        if found is None:
            raise NotDatalogError
        return found

    def _read(self, key: Key) -> list[Rule] | None:
        predicate = self.known[key]
        if predicate.virtual is not None or predicate.origin == "library":
            return None
        try:
            return [rule_of(c) for c in predicate.clauses if c.body is not None or not _is_row(c)]
        except NotDatalogError:
            return None

    def _refuse_loops(self, group: Sequence[Key], graph: dict[Key, list[Key]], query: Rule) -> None:
        """Leave loops to tabling unless all of a tabled relation is asked for."""
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
                    self._run(rule, plan(rule, self.relations), made[rule.key], [])
        except BaseException:
            for key in group:
                del self.relations[key]
            raise

    def _facts(self, clauses: Iterable[Clause]) -> Relation:
        relation = Relation()
        for clause in clauses:
            if clause.body is None and _is_row(clause):
                relation.add(clause.head, clause)
        return relation

    def _to_the_end(self, rules: Sequence[Rule], group: Sequence[Key]) -> None:
        """Run rules that need each other until nothing is new: only new rows are joined."""
        new = {key: list(self.relations[key].rows) for key in group}
        for rule in rules:
            self._run(rule, plan(rule, self.relations), self.relations[rule.key], new[rule.key])
        while any(new.values()):
            deltas = {key: _relation_of(rows) for key, rows in new.items()}
            new = {key: [] for key in group}
            for rule, literal in _recursive(rules, group):
                made = plan(rule, self.relations, (literal, deltas[literal.key]))
                self._run(rule, made, self.relations[rule.key], new[rule.key])

    def _run(self, rule: Rule, made: Plan, target: Relation, new: list[Row]) -> None:
        env: Env = ["" for _ in range(rule.size)]
        if not all(test(env) for test in made.before):
            return
        if all(self._search(steps, 0, env, None) for steps in made.groups):
            self._search(made.steps, 0, env, _Collector(rule, target, new))

    def _search(
        self, steps: Sequence[Step], number: int, env: Env, collector: _Collector | None
    ) -> bool:
        """Look for matches of all steps from one on; tell whether there was any."""
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

    rule: Rule
    target: Relation
    new: list[Row]

    def row(self, env: Env) -> Row:
        return tuple(env[a.index] if isinstance(a, Slot) else a for a in self.rule.head)

    def has(self, env: Env) -> bool:
        """Tell whether the row is known already."""
        return self.row(env) in self.target.rows

    def add(self, env: Env) -> bool:
        row = self.row(env)
        if self.target.add(row, (self.rule, tuple(env))):
            self.new.append(row)
        return True


def _needed(rules: Iterable[Rule]) -> list[Key]:
    keys = (lit.key for rule in rules for lit in rule.literals if lit.test is None)
    return list(dict.fromkeys(keys))


def _is_row(clause: Clause) -> bool:
    return not clause.goals and all(map(is_atomic, clause.head))


def _is_loop(group: Sequence[Key], graph: dict[Key, list[Key]]) -> bool:
    return len(group) > 1 or group[0] in graph[group[0]]


def _relation_of(rows: Iterable[Row]) -> Relation:
    relation = Relation()
    for row in rows:
        relation.add(row, None)
    return relation


def _recursive(rules: Iterable[Rule], group: Sequence[Key]) -> list[tuple[Rule, Literal]]:
    return [(rule, lit) for rule in rules for lit in rule.relations if lit.key in group]
