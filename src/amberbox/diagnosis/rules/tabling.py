"""Tabling: predicates that may call themselves, to the left as well, and still come to an end.

Each call, up to the names of its variables, has a table of its answers. A call of a table that
is still being filled suspends: what was left to do up to the outer table is kept (a consumer)
and resumed for every answer, until there are no new ones. Tables that depend on each other are
filled together (a component) and complete together.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from amberbox.diagnosis.rules.clauses import Frame, Goal, Predicate
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.proof import Node, Trace, copy_trace, node_of
from amberbox.diagnosis.rules.terms import Key, Term, make
from amberbox.diagnosis.rules.unify import Memo, copy, unify, variant
from amberbox.diagnosis.rules.writer import write

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine

BARRIERS: list[Goal] = []
"""Ends of negations, conditions and findall: a consumer cannot be resumed across them."""

Answer = tuple[Term, ...]


@dataclass(eq=False)
class _Consumer:
    """A call that waits for answers: its arguments and what is left to do after it."""

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
    order: list[tuple[Answer, bool, Node | None]] = field(default_factory=list)
    """Answers as they came, whether they have variables, and why they hold."""
    consumers: list[_Consumer] = field(default_factory=list)
    complete: bool = False

    def __str__(self) -> str:
        return write(make(self.key[0], self.args))


def call(m: Machine, predicate: Predicate, args: Sequence[Term], after: Frame) -> Frame | None:
    """Call a tabled predicate: use its table, wait for it, or fill it."""
    called = variant(args)
    m.charge(len(called))
    key = (predicate.key, called)
    table: _Table | None = m.tables.get(key)
    if table is None:
        return _begin(m, predicate, key, tuple(args), after)
    if table.complete:
        return _feed(m, table, 0, args, after)
    _merge(m, table)
    _suspend(m, table, args, after)
    return None


def _begin(
    m: Machine, predicate: Predicate, key: Hashable, args: Answer, after: Frame
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


def _add(m: Machine, goal: Goal, env: Any, cut: int, after: Frame) -> None:
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


def _exhausted(m: Machine, table: _Table, args: Answer, after: Frame) -> Frame | None:
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


def _resume(m: Machine, table: _Table, consumer: _Consumer) -> Frame | None:
    answer = table.order[consumer.seen]
    consumer.seen += 1
    consumer.is_waiting = False
    _wake(table, consumer)
    m.trace = consumer.trace
    return consumer.after if _agrees(m, consumer.args, answer) else None


def _agrees(m: Machine, args: Sequence[Term], given: tuple[Answer, bool, Node | None]) -> bool:
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
    m: Machine, table: _Table, number: int, args: Sequence[Term], after: Frame
) -> Frame | None:
    """Go on once for every answer of a complete table."""
    if number >= len(table.order):
        return None
    if number + 1 < len(table.order):
        m.choose(_feed, table, number + 1, args, after)
    return after if _agrees(m, args, table.order[number]) else None


def _merge(m: Machine, table: _Table) -> None:
    """Join the components from the present one down to the one of a table that is being filled."""
    target = table.component.root()
    component = m.stack[-1].component.root()
    while component is not target:
        component.merged_into = target
        target.agenda.extend(component.agenda)
        target.tables.extend(component.tables)
        assert component.parent is not None  # a table that is being filled is below us
        component = component.parent.root()


def _suspend(m: Machine, table: _Table, args: Sequence[Term], after: Frame) -> None:
    """Keep a call that has to wait, with what is left to do after it."""
    memo: Memo = {}
    frame = _copy_frames(m, table, after, memo)
    own = tuple(copy(arg, memo) for arg in args)
    consumer = _Consumer(own, frame, copy_trace(m.trace, memo) if m.proving else None)
    table.consumers.append(consumer)
    _wake(table, consumer)


def _copy_frames(m: Machine, table: _Table, frame: Frame, memo: Memo) -> Frame:
    frames: list[Frame] = []
    while frame[0] is not _ADD:
        if frame[0] in BARRIERS or frame[0].cuts:
            raise _not_stratified(m, table, frame[0])
        frames.append(frame)
        frame = frame[3]
    goal, (filled, args), cut, _, depth = frame
    last: Frame = (goal, (filled, tuple(copy(arg, memo) for arg in args)), cut, None, depth)
    for goal, env, cut, _, depth in reversed(frames):
        own = None if env is None else [copy(term, memo) for term in env]
        last = (goal, own, cut, last, depth)
    return last


def _not_stratified(m: Machine, table: _Table, barrier: Goal) -> RuleFault:
    if m.stack[-1] is table and table.component.root().leader is not None:
        table = table.component.root().leader  # found when it was exhausted: it called this one
    names = [str(entry) for entry in m.stack[m.stack.index(table) :]]
    shown = names if len(names) < 8 else [*names[:4], "...", *names[-3:]]
    cycle = " -> ".join((*shown, str(table)))
    kinds = {"\\+": "its own negation", "findall": "all solutions of itself", "!": "a cut"}
    what = kinds.get(barrier.key[0], "a condition that is run once")
    hint = "through \\+, findall, -> and ! a tabled predicate must not depend on itself"
    return RuleFault(f"{table} depends on {what}: {cycle}", hint)


_ADD = Goal(_add, ("$add", 0))
