"""Built-in predicates on terms: equality, order, kinds, arithmetic, taking apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from amberbox.diagnosis.rules.arithmetic import evaluate, plain
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.order import compare
from amberbox.diagnosis.rules.terms import (
    NIL,
    Key,
    Real,
    Struct,
    Term,
    Text,
    Var,
    args_of,
    deref,
    is_atomic,
    is_callable,
    make,
    make_list,
    split_list,
)
from amberbox.diagnosis.rules.unify import copy, free_variables, undo, variant

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine

Args = list[Term]
_MOST_ARGS = 1000


def whole(term: Term, what: str) -> int:
    """Return a whole number; raise RuleFault if the argument is none."""
    value = deref(term)
    if isinstance(value, int):
        return value
    has = "no value yet" if isinstance(value, Var) else "another kind of value"
    raise RuleFault(f"{what} needs a whole number and has {has}")


def proper_list(term: Term, what: str) -> list[Term]:
    """Return the elements of a list; raise RuleFault if the argument is none."""
    items, tail = split_list(term)
    if tail != "[]":
        has = "a list without an end" if isinstance(tail, Var) else "something else"
        raise RuleFault(f"{what} needs a list and has {has}")
    return items


def differ(m: Machine, left: Term, right: Term) -> bool:
    """Tell whether two terms cannot be made equal; binds nothing."""
    mark = len(m.trail)
    equal = m.unify(left, right)
    undo(m.trail, mark)
    return not equal


def _kind(is_kind: Callable[[Term], bool]) -> Callable[[Any, Args], bool]:
    return lambda m, args: is_kind(deref(args[0]))


def _arithmetic(holds: Callable[[float, float], bool]) -> Callable[[Any, Args], bool]:
    return lambda m, args: holds(plain(evaluate(args[0])), plain(evaluate(args[1])))


def _ordered(holds: Callable[[int], bool]) -> Callable[[Any, Args], bool]:
    return lambda m, args: holds(compare(args[0], args[1]))


def _compare(m: Machine, args: Args) -> bool:
    return m.unify(args[0], "<=>"[compare(args[1], args[2]) + 1])


def _functor(m: Machine, args: Args) -> bool:
    term = deref(args[0])
    if isinstance(term, Var):
        return m.unify(term, _new(deref(args[1]), whole(args[2], "functor/3")))
    name: Term = term.name if isinstance(term, Struct) else term
    return m.unify(args[1], name) and m.unify(args[2], len(args_of(term)))


def _new(name: Term, count: int) -> Term:
    if count == 0 and is_atomic(name):
        return name
    if not isinstance(name, str) or not 0 <= count <= _MOST_ARGS:
        raise RuleFault("functor/3 needs a name and how many arguments there are")
    return Struct(name, tuple(Var() for _ in range(count)))


def _arg(m: Machine, args: Args) -> Iterator[None]:
    term = deref(args[1])
    if not isinstance(term, Struct):
        raise RuleFault("arg/3 needs a structure")
    if isinstance(deref(args[0]), Var):
        for number, part in enumerate(term.args, 1):
            mark = len(m.trail)
            if m.unify(args[0], number) and m.unify(args[2], part):
                yield
            undo(m.trail, mark)
        return
    number = whole(args[0], "arg/3")
    if 1 <= number <= len(term.args) and m.unify(args[2], term.args[number - 1]):
        yield


def _univ(m: Machine, args: Args) -> bool:
    term = deref(args[0])
    if isinstance(term, Struct):
        return m.unify(args[1], make_list([term.name, *term.args]))
    if not isinstance(term, Var):
        return m.unify(args[1], make_list([term]))
    first, *rest = proper_list(args[1], "=..") or [Var()]
    name = deref(first)
    if not rest and is_atomic(name):
        return m.unify(term, name)
    if not isinstance(name, str):
        raise RuleFault("=.. needs a name at the beginning of its list")
    return m.unify(term, make(name, rest))


def _occurs(m: Machine, args: Args) -> bool:
    """Unify with occurs check: fail where a variable would contain itself."""
    mark = len(m.trail)
    if not m.unify(args[0], args[1]):
        return False
    return not any(_contains_itself(variable) for variable in m.trail[mark:])


def _contains_itself(variable: Var) -> bool:
    open_terms: list[Term] = [variable.ref] if variable.ref is not None else []
    while open_terms:
        term = open_terms.pop()
        while isinstance(term, Var) and term is not variable and term.ref is not None:
            term = term.ref
        if term is variable:
            return True
        if isinstance(term, Struct):
            open_terms.extend(term.args)
    return False


def _ground(m: Machine, args: Args) -> bool:
    return not free_variables(args[:1])


def _variables(m: Machine, args: Args) -> bool:
    return m.unify(args[1], make_list(free_variables(args[:1])))


def _is_list(term: Term) -> bool:
    return split_list(term)[1] == "[]"


TESTS: Mapping[Key, Callable[[Any, Args], bool]] = {
    ("=", 2): lambda m, args: m.unify(args[0], args[1]),
    ("\\=", 2): lambda m, args: differ(m, args[0], args[1]),
    ("unify_with_occurs_check", 2): _occurs,
    ("==", 2): _ordered(lambda sign: sign == 0),
    ("\\==", 2): _ordered(lambda sign: sign != 0),
    ("@<", 2): _ordered(lambda sign: sign < 0),
    ("@=<", 2): _ordered(lambda sign: sign <= 0),
    ("@>", 2): _ordered(lambda sign: sign > 0),
    ("@>=", 2): _ordered(lambda sign: sign >= 0),
    ("compare", 3): _compare,
    ("=@=", 2): lambda m, args: variant(args[:1]) == variant(args[1:]),
    ("\\=@=", 2): lambda m, args: variant(args[:1]) != variant(args[1:]),
    ("is", 2): lambda m, args: m.unify(args[0], evaluate(args[1])),
    ("=:=", 2): _arithmetic(lambda a, b: a == b),
    ("=\\=", 2): _arithmetic(lambda a, b: a != b),
    ("<", 2): _arithmetic(lambda a, b: a < b),
    ("=<", 2): _arithmetic(lambda a, b: a <= b),
    (">", 2): _arithmetic(lambda a, b: a > b),
    (">=", 2): _arithmetic(lambda a, b: a >= b),
    ("var", 1): _kind(lambda term: isinstance(term, Var)),
    ("nonvar", 1): _kind(lambda term: not isinstance(term, Var)),
    ("atom", 1): _kind(lambda term: isinstance(term, str) and term != NIL),
    ("number", 1): _kind(lambda term: isinstance(term, int | Real)),
    ("integer", 1): _kind(lambda term: isinstance(term, int)),
    ("float", 1): _kind(lambda term: isinstance(term, Real)),
    ("atomic", 1): _kind(is_atomic),
    ("compound", 1): _kind(lambda term: isinstance(term, Struct)),
    ("callable", 1): _kind(is_callable),
    ("string", 1): _kind(lambda term: isinstance(term, Text)),
    ("is_list", 1): _kind(_is_list),
    ("ground", 1): _ground,
    ("functor", 3): _functor,
    ("=..", 2): _univ,
    ("copy_term", 2): lambda m, args: m.unify(args[1], copy(args[0], {})),
    ("term_variables", 2): _variables,
}
SEVERAL: Mapping[Key, Callable[[Any, Args], Iterator[None]]] = {("arg", 3): _arg}
