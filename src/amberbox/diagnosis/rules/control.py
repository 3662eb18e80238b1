"""What steers a search: calls, cut, if-then-else, negation, findall."""

from __future__ import annotations

from typing import Any

from amberbox.diagnosis.rules import tabling
from amberbox.diagnosis.rules.clauses import Frame, Goal
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.machine import Machine, term_of
from amberbox.diagnosis.rules.terms import Env, Struct, Term, deref, make_list
from amberbox.diagnosis.rules.unify import build, copy


def call(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Call a predicate by its name."""
    args = [build(arg, env) for arg in goal.args]
    predicate = m.predicate(goal.key)
    if predicate.tabled:
        return tabling.call(m, predicate, args, after)
    if predicate.virtual is not None:
        return m.each(predicate.virtual.solutions(m, args), goal, term_of(goal, args), after)
    return m.call(predicate, args, after)


def test(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Run a built-in predicate that has at most one solution."""
    args = [build(arg, env) for arg in goal.args]
    if not goal.extra(m, args):
        return None
    if m.proving:
        m.note(term_of(goal, args))
    return after


def several(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame | None:
    """Run a built-in predicate that may have several solutions."""
    args = [build(arg, env) for arg in goal.args]
    return m.each(goal.extra(m, args), goal, term_of(goal, args), after)


def fail(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> None:
    """Fail."""


def cut_clause(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Forget what else might be tried since the clause was entered."""
    m.cut(cut)
    return after


def _enter(chain: Goal | None, env: Any, cut: int, after: Frame) -> Frame:
    return after if chain is None else (chain, env, cut, after, after[4])


def either(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Run one goal, on going back the other."""
    left, right = goal.extra
    m.choose(_go_on, right, env, cut, after)
    return _enter(left, env, cut, after)


def _go_on(m: Machine, chain: Goal | None, env: Any, cut: int, after: Frame) -> Frame:
    return _enter(chain, env, cut, after)


def if_then_else(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Run the condition once, and then one of the branches."""
    condition, then, otherwise = goal.extra
    height = len(m.choices)
    m.choose(_go_on, otherwise, env, cut, after)
    then_frame = _enter(then, env, cut, after)
    return _enter(condition, env, height + 1, (COMMIT, height, 0, then_frame, after[4]))


def _commit(m: Machine, goal: Goal, height: Any, cut: int, after: Frame) -> Frame:
    m.cut(height)
    return after


def negation(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Go on if the goal has no solution."""
    height = len(m.choices)
    m.choose(_was_not, goal, env, after)
    return _enter(goal.extra, env, height + 1, (REFUTE, height, 0, after, after[4]))


def _was_not(m: Machine, goal: Goal, env: Env, after: Frame) -> Frame:
    if m.proving:
        m.note(copy(term_of(goal, [build(arg, env) for arg in goal.args]), None))
    return after


def _refute(m: Machine, goal: Goal, height: Any, cut: int, after: Frame) -> None:
    m.cut(height)


def find_all(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Collect copies of a term for every solution of a goal."""
    template, _, result = (build(arg, env) for arg in goal.args)
    found: list[Term] = []
    m.choose(_found_all, goal, env, found, result, after)
    collect: Frame = (COLLECT, (template, found), 0, after, after[4])
    return _enter(goal.extra, env, len(m.choices), collect)


def _collect(m: Machine, goal: Goal, bag: Any, cut: int, after: Frame) -> None:
    template, found = bag
    found.append(copy(template, {}))


def _found_all(
    m: Machine, goal: Goal, env: Env, found: list[Term], result: Term, after: Frame
) -> Frame | None:
    m.goal = goal
    if not m.unify(result, make_list(found)):
        return None
    if m.proving:
        m.note(term_of(goal, [build(arg, env) for arg in goal.args]))
    return after


def apart(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
    """Run goals in which a cut stays inside."""
    return _enter(goal.extra, env, len(m.choices), after)


def call_term(m: Machine, goal: Goal, env: Env, cut: int, after: Frame) -> Frame:
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
    from amberbox.diagnosis.rules.compile import compile_goal  # it needs the functions above

    return _enter(compile_goal(target, goal.place), [], len(m.choices), after)


COMMIT = Goal(_commit, ("->", 2))
REFUTE = Goal(_refute, ("\\+", 1))
COLLECT = Goal(_collect, ("findall", 3))
tabling.BARRIERS.extend((COMMIT, REFUTE, COLLECT))
