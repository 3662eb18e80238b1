"""Compile clauses for the solver, with control goals and tabled predicates.

Control goals are call, cut, if-then-else, negation and findall. A tabled predicate may call
itself, also left-recursively, and still terminates.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from amberbox.diagnosis.prolog.builtins import SEVERAL, TESTS
from amberbox.diagnosis.prolog.machine import (
    Frame,
    Op,
    PrologClause,
    PrologGoal,
    PrologMachine,
    PrologPredicate,
    ProofNode,
    Trace,
    chain,
    copy_trace,
    flatten,
    node_of,
    term_of,
)
from amberbox.diagnosis.prolog.syntax import write
from amberbox.diagnosis.prolog.terms import (
    Env,
    Key,
    Memo,
    Pattern,
    RuleFault,
    Slot,
    SourcePosition,
    Struct,
    Term,
    Var,
    build,
    copy,
    deref,
    key_of,
    make,
    make_list,
    unify,
    variant,
)

if TYPE_CHECKING:
    from amberbox.diagnosis.prolog.machine import PrologMachine


def call(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Call a predicate by its name."""
    args = [build(arg, env) for arg in goal.args]
    predicate = m.predicate(goal.key)
    if predicate.tabled:
        return call_tabled(m, predicate, args, after)
    if predicate.virtual is not None:
        return m.each(predicate.virtual.solutions(m, args), goal, term_of(goal, args), after)
    return m.call(predicate, args, after)


def test(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Run a built-in predicate that has at most one solution."""
    args = [build(arg, env) for arg in goal.args]
    if not goal.extra(m, args):
        return None
    if m.proving:
        m.note(term_of(goal, args))
    return after


def several(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Run a built-in predicate that may have several solutions."""
    args = [build(arg, env) for arg in goal.args]
    return m.each(goal.extra(m, args), goal, term_of(goal, args), after)


def fail(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> None:
    """Fail."""


def cut_clause(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Forget what else might be tried since the clause was entered."""
    m.cut(cut)
    return after


def _enter(chain: PrologGoal | None, env: Any, cut: int, after: Frame) -> Frame:
    return after if chain is None else (chain, env, cut, after, after[4])


def either(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Run one goal, on going back the other."""
    left, right = goal.extra
    m.choose(_go_on, right, env, cut, after)
    return _enter(left, env, cut, after)


def _go_on(m: PrologMachine, chain: PrologGoal | None, env: Any, cut: int, after: Frame) -> Frame:
    return _enter(chain, env, cut, after)


def if_then_else(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Run the condition once, and then one of the branches."""
    condition, then, otherwise = goal.extra
    height = len(m.choices)
    m.choose(_go_on, otherwise, env, cut, after)
    then_frame = _enter(then, env, cut, after)
    return _enter(condition, env, height + 1, (COMMIT, height, 0, then_frame, after[4]))


def _commit(m: PrologMachine, goal: PrologGoal, height: Any, cut: int, after: Frame) -> Frame:
    m.cut(height)
    return after


def negation(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Go on if the goal has no solution."""
    height = len(m.choices)
    m.choose(_was_not, goal, env, after)
    return _enter(goal.extra, env, height + 1, (REFUTE, height, 0, after, after[4]))


def _was_not(m: PrologMachine, goal: PrologGoal, env: Env, after: Frame) -> Frame:
    if m.proving:
        m.note(copy(term_of(goal, [build(arg, env) for arg in goal.args]), None))
    return after


def _refute(m: PrologMachine, goal: PrologGoal, height: Any, cut: int, after: Frame) -> None:
    m.cut(height)


def find_all(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Collect copies of a term for every solution of a goal."""
    template, _, result = (build(arg, env) for arg in goal.args)
    found: list[Term] = []
    m.choose(_found_all, goal, env, found, result, after)
    collect: Frame = (COLLECT, (template, found), 0, after, after[4])
    return _enter(goal.extra, env, len(m.choices), collect)


def _collect(m: PrologMachine, goal: PrologGoal, bag: Any, cut: int, after: Frame) -> None:
    template, found = bag
    found.append(copy(template, {}))


def _found_all(
    m: PrologMachine, goal: PrologGoal, env: Env, found: list[Term], result: Term, after: Frame
) -> Frame | None:
    m.goal = goal
    if not m.unify(result, make_list(found)):
        return None
    if m.proving:
        m.note(term_of(goal, [build(arg, env) for arg in goal.args]))
    return after


def apart(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Run goals in which a cut stays inside."""
    return _enter(goal.extra, env, len(m.choices), after)


def call_term(m: PrologMachine, goal: PrologGoal, env: Env, cut: int, after: Frame) -> Frame:
    """Run a term as a goal, with more arguments at its end: ``call/N``."""
    first, *more = (build(arg, env) for arg in goal.args)
    target = deref(first)
    if more:
        if isinstance(target, str):
            target = Struct(target, tuple(more))
        elif isinstance(target, Struct):
            target = Struct(target.name, (*target.args, *more))
    if not isinstance(target, str | Struct):
        raise RuleFault(f"{goal.key[0]} needs a goal", "its variable has no value yet")

    return _enter(compile_goal(target, goal.place), [], len(m.choices), after)


COMMIT = PrologGoal(_commit, ("->", 2))
REFUTE = PrologGoal(_refute, ("\\+", 1))
COLLECT = PrologGoal(_collect, ("findall", 3))
# Ends of negations, conditions and findall: a consumer cannot be resumed across them
_BARRIERS = (COMMIT, REFUTE, COLLECT)


Where = Callable[[Term], "SourcePosition | None"]  # position of a goal

# Goals that steer the search; rules cannot define them
CONTROL: frozenset[Key] = frozenset(
    {(",", 2), (";", 2), ("|", 2), ("->", 2), ("\\+", 1), ("not", 1), ("!", 0), ("findall", 3),
     ("forall", 2), ("once", 1), ("ignore", 1), ("true", 0), ("fail", 0), ("false", 0),
     *(("call", count) for count in range(1, 9))}
)  # fmt: skip

FIXED: frozenset[Key] = CONTROL | TESTS.keys() | SEVERAL.keys()  # goals that rules cannot define


def compile_clause(
    term: Term, place: SourcePosition, where: Where, names: dict[Var, str]
) -> PrologClause:
    """Compile a fact or a rule; raise RuleFault if it can be neither."""
    head, body = term, None
    if isinstance(term, Struct) and term.name == ":-" and len(term.args) == 2:
        head, body = deref(term.args[0]), term.args[1]
    key = key_of(head)
    if key is None:
        raise RuleFault("a fact or the head of a rule must have a name", "such as: broken(X)")
    compiler = _Compiler(where)
    patterns = tuple(compiler.pattern(arg) for arg in head.args) if isinstance(head, Struct) else ()
    used = len(compiler.slots)
    goals = compiler.goals(body) if body is not None else None
    shown = () if body is None else tuple(compiler.pattern(goal) for goal in flatten(body))
    size = len(compiler.slots)
    labels = tuple(names.get(variable, "_") for variable in compiler.slots)
    return PrologClause(key, patterns, goals, size, tuple(range(used, size)), place, shown, labels)


def compile_goal(term: Term, place: SourcePosition | None = None) -> PrologGoal | None:
    """Compile a goal whose variables are in use already; None for an empty goal."""
    return _Compiler(lambda _: place, in_use=True).goals(term)


@dataclass
class _Compiler:
    where: Where
    slots: dict[Var, Slot] = field(default_factory=dict)
    in_use: bool = False

    def pattern(self, term: Term) -> Term:
        """Replace variables by slots; a term without variables stays unchanged."""
        if self.in_use:
            return term
        spine: list[tuple[Struct, list[Term]]] = []
        term = deref(term)
        while isinstance(term, Struct):
            spine.append((term, [self.pattern(part) for part in term.args[:-1]]))
            term = deref(term.args[-1])
        if isinstance(term, Var):
            term = self.slots.setdefault(term, Slot(len(self.slots)))
        for struct, parts in reversed(spine):
            args = (*parts, term)
            is_open = any(isinstance(arg, Slot | Pattern) for arg in args)
            term = Pattern(struct.name, args) if is_open else struct
        return term

    def goals(self, body: Term) -> PrologGoal | None:
        """Compile a body to a chain of goals."""
        return chain([goal for term in flatten(body) for goal in self.goal(term)])

    def goal(self, term: Term) -> Iterator[PrologGoal]:
        """Compile one goal that is no conjunction."""
        key = key_of(term)
        if isinstance(term, Var):
            yield PrologGoal(call_term, ("call", 1), (self.pattern(term),))
        elif key is None:
            raise RuleFault("a number or a text is no goal", "a goal has a name: ready(X)")
        elif key in CONTROL:
            yield from self._control(term, key)
        else:
            yield self._plain(key, self._args(term), self.where(term))

    def _args(self, term: Term) -> tuple[Term, ...]:
        return tuple(self.pattern(arg) for arg in term.args) if isinstance(term, Struct) else ()

    def _plain(self, key: Key, args: tuple[Term, ...], place: SourcePosition | None) -> PrologGoal:
        if key in TESTS:
            return PrologGoal(test, key, args, TESTS[key], place)
        if key in SEVERAL:
            return PrologGoal(several, key, args, SEVERAL[key], place)
        return PrologGoal(call, key, args, None, place)

    def _control(self, term: Term, key: Key) -> Iterator[PrologGoal]:
        name, place = key[0], self.where(term)
        inner = [deref(arg) for arg in term.args] if isinstance(term, Struct) else []
        args = () if name in (";", "|", "->") else self._args(term)
        if name in (";", "|"):
            yield self._choice(term)
        elif name == "!":
            goal = PrologGoal(cut_clause, key, place=place)
            goal.cuts = True
            yield goal
        elif name in ("fail", "false"):
            yield PrologGoal(fail, key, place=place)
        elif name == "->":
            parts = [*map(self.goals, inner), self.goals("fail")]
            yield _branching(if_then_else, key, parts, place)
        elif name in ("\\+", "not"):
            yield PrologGoal(negation, key, args, self.goals(inner[0]), place)
        elif name == "findall":
            yield PrologGoal(find_all, key, args, self.goals(inner[1]), place)
        elif name == "forall":
            unless = Struct("\\+", (Struct(",", (inner[0], Struct("\\+", (inner[1],)))),))
            yield PrologGoal(negation, key, args, self.goals(unless.args[0]), place)
        elif name in ("once", "ignore"):
            otherwise = None if name == "ignore" else self.goals("fail")
            extra = self.goals(inner[0]), None, otherwise
            yield PrologGoal(if_then_else, key, args, extra, place)
        elif name == "call":
            yield self._call(inner, args, place)

    def _call(
        self, inner: list[Term], args: tuple[Term, ...], place: SourcePosition | None
    ) -> PrologGoal:
        if len(inner) == 1 and isinstance(inner[0], Struct):
            return PrologGoal(apart, ("call", 1), args, self.goals(inner[0]), place)
        return PrologGoal(call_term, ("call", len(args)), args, None, place)

    def _choice(self, term: Term) -> PrologGoal:
        """Compile ``a ; b ; c``, where any may be ``c -> a``, without descending once per ``;``."""
        spine: list[Struct] = []
        while isinstance(term, Struct) and key_of(term) in ((";", 2), ("|", 2)):
            spine.append(term)
            term = deref(term.args[1])
        rest = self.goals(term)
        for choice in reversed(spine):
            first, place = deref(choice.args[0]), self.where(choice)
            if isinstance(first, Struct) and key_of(first) == ("->", 2):
                parts = [*map(self.goals, first.args), rest]
                rest = _branching(if_then_else, (";", 2), parts, place)
            else:
                rest = _branching(either, (";", 2), [self.goals(first), rest], place)
        assert rest is not None  # there was a choice
        return rest


def _branching(
    op: Op, key: Key, parts: Sequence[PrologGoal | None], place: SourcePosition | None
) -> PrologGoal:
    goal = PrologGoal(op, key, (), tuple(parts), place)
    goal.cuts = any(part is not None and part.cuts for part in parts[-2:])  # not the condition's
    return goal


Answer = tuple[Term, ...]


@dataclass(eq=False)
class _Consumer:
    """A call that waits for answers: its arguments and its continuation."""

    args: Answer
    after: Frame
    trace: Trace
    seen: int = 0
    is_waiting: bool = False


@dataclass(eq=False)
class _Component:
    """Tables that depend on each other; the leader was called first."""

    leader: _Table | None = None
    parent: _Component | None = None
    merged_into: _Component | None = None
    agenda: deque[tuple[_Table, _Consumer]] = field(default_factory=deque)
    tables: list[_Table] = field(default_factory=list)

    def root(self) -> _Component:
        component = self
        while component.merged_into is not None:
            component = component.merged_into
        return component


@dataclass(eq=False)
class _Table:
    """The answers of one call."""

    key: Key
    args: Answer
    component: _Component
    answers: dict[Hashable, Answer] = field(default_factory=dict)
    # Answers as they came, whether they have variables, and why they hold
    order: list[tuple[Answer, bool, ProofNode | None]] = field(default_factory=list)
    consumers: list[_Consumer] = field(default_factory=list)
    complete: bool = False

    def __str__(self) -> str:
        return write(make(self.key[0], self.args))


def call_tabled(
    m: PrologMachine, predicate: PrologPredicate, args: Sequence[Term], after: Frame
) -> Frame | None:
    """Call a tabled predicate: use its table, wait for it, or fill it."""
    called = variant(args)
    m.charge(len(called))
    key = (predicate.key, called)
    table: _Table | None = m.tables.get(key)
    if table is None:
        return _begin(m, predicate, key, tuple(args), after)
    if table.complete:
        return _feed(m, table, 0, args, after)
    # Join the components from the present one down to the one of a table that is being filled.
    target = table.component.root()
    component = m.stack[-1].component.root()
    while component is not target:
        component.merged_into = target
        target.agenda.extend(component.agenda)
        target.tables.extend(component.tables)
        assert component.parent is not None  # a table that is being filled is below us
        component = component.parent.root()
    _suspend(m, table, args, after)
    return None


def _begin(
    m: PrologMachine, predicate: PrologPredicate, key: Hashable, args: Answer, after: Frame
) -> Frame | None:
    memo: Memo = {}
    own = tuple(copy(arg, memo) for arg in args)
    parent = m.stack[-1].component.root() if m.stack else None
    component = _Component(None, parent)
    table = component.leader = m.tables[key] = _Table(predicate.key, own, component)
    component.tables.append(table)
    m.stack.append(table)
    m.choose(_exhausted, table, args, after)
    m.trace = None
    # The table's own arguments stay free: the clauses run on another copy.
    fresh: Memo = {}
    called = tuple(copy(arg, fresh) for arg in own)
    add: Frame = (_ADD, (table, called), 0, None, after[4] + 1)
    return m.call(predicate, called, add)


def _add(m: PrologMachine, goal: PrologGoal, env: Any, cut: int, after: Frame) -> None:
    """Keep an answer, unless it is known, and wake those who wait for it."""
    table, args = env
    key = variant(args)
    m.charge(len(key))
    if key in table.answers:
        return
    memo: Memo = {}
    answer = tuple(copy(arg, memo) for arg in args)
    table.answers[key] = answer
    node = node_of(m.trace, make(table.key[0], answer)) if m.proving else None
    table.order.append((answer, bool(memo), node))
    for consumer in table.consumers:
        _wake(table, consumer)


def _wake(table: _Table, consumer: _Consumer) -> None:
    if not consumer.is_waiting and consumer.seen < len(table.order):
        consumer.is_waiting = True
        table.component.root().agenda.append((table, consumer))


def _exhausted(m: PrologMachine, table: _Table, args: Answer, after: Frame) -> Frame | None:
    """Resume a consumer, or end the table when nothing is left to do for it."""
    component = table.component.root()
    if component.leader is not table:
        _suspend(m, table, args, after)
        m.stack.pop()
        return None
    if component.agenda:
        m.choose(_exhausted, table, args, after)
        return _resume(m, *component.agenda.popleft())
    m.stack.pop()
    for filled in component.tables:
        filled.complete = True
        filled.consumers.clear()
    return _feed(m, table, 0, args, after)


def _resume(m: PrologMachine, table: _Table, consumer: _Consumer) -> Frame | None:
    answer = table.order[consumer.seen]
    consumer.seen += 1
    consumer.is_waiting = False
    _wake(table, consumer)
    m.trace = consumer.trace
    return consumer.after if _agrees(m, consumer.args, answer) else None


def _agrees(
    m: PrologMachine, args: Sequence[Term], given: tuple[Answer, bool, ProofNode | None]
) -> bool:
    answer, has_variables, node = given
    if has_variables:
        memo: Memo = {}
        answer = tuple(copy(arg, memo) for arg in answer)
    for arg, part in zip(args, answer, strict=True):
        if not unify(arg, part, m.trail):
            return False
    if node is not None:
        m.note(node)
    return True


def _feed(
    m: PrologMachine, table: _Table, number: int, args: Sequence[Term], after: Frame
) -> Frame | None:
    """Go on once for every answer of a complete table."""
    if number >= len(table.order):
        return None
    if number + 1 < len(table.order):
        m.choose(_feed, table, number + 1, args, after)
    return after if _agrees(m, args, table.order[number]) else None


def _suspend(m: PrologMachine, table: _Table, args: Sequence[Term], after: Frame) -> None:
    """Store a call that has to wait, with its continuation."""
    memo: Memo = {}
    frame = _copy_frames(m, table, after, memo)
    own = tuple(copy(arg, memo) for arg in args)
    consumer = _Consumer(own, frame, copy_trace(m.trace, memo) if m.proving else None)
    table.consumers.append(consumer)
    _wake(table, consumer)


def _copy_frames(m: PrologMachine, table: _Table, frame: Frame, memo: Memo) -> Frame:
    frames: list[Frame] = []
    while frame[0] is not _ADD:
        if frame[0] in _BARRIERS or frame[0].cuts:
            raise _not_stratified(m, table, frame[0])
        frames.append(frame)
        frame = frame[3]
    goal, (filled, args), cut, _, depth = frame
    last: Frame = (goal, (filled, tuple(copy(arg, memo) for arg in args)), cut, None, depth)
    for goal, env, cut, _, depth in reversed(frames):
        own = None if env is None else [copy(term, memo) for term in env]
        last = (goal, own, cut, last, depth)
    return last


def _not_stratified(m: PrologMachine, table: _Table, barrier: PrologGoal) -> RuleFault:
    if m.stack[-1] is table and table.component.root().leader is not None:
        table = table.component.root().leader  # found when it was exhausted: it called this one
    names = [str(entry) for entry in m.stack[m.stack.index(table) :]]
    shown = names if len(names) < 8 else [*names[:4], "...", *names[-3:]]
    cycle = " -> ".join((*shown, str(table)))
    kinds = {"\\+": "its own negation", "findall": "all solutions of itself", "!": "a cut"}
    what = kinds.get(barrier.key[0], "a condition that is run once")
    hint = "through \\+, findall, -> and ! a tabled predicate must not depend on itself"
    return RuleFault(f"{table} depends on {what}: {cycle}", hint)


_ADD = PrologGoal(_add, ("$add", 0))
