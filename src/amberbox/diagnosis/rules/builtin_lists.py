"""Built-in predicates on lists and numbers of a range."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cmp_to_key
from typing import TYPE_CHECKING, Any

from amberbox.diagnosis.rules.builtin_terms import Args, proper_list, whole
from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.order import compare, in_order, once_each
from amberbox.diagnosis.rules.terms import Key, Struct, Term, Var, deref, make_list, split_list
from amberbox.diagnosis.rules.unify import undo

if TYPE_CHECKING:
    from amberbox.diagnosis.rules.machine import Machine

_MOST = 10_000_000


def _between(m: Machine, args: Args) -> Iterator[None]:
    low = whole(args[0], "between/3")
    last = deref(args[1])
    high = None if last in ("inf", "infinite") else whole(last, "between/3")
    value = deref(args[2])
    if not isinstance(value, Var):
        number = whole(value, "between/3")
        if low <= number and (high is None or number <= high):
            yield
        return
    while high is None or low <= high:
        m.unify(value, low)
        yield
        low += 1


def _length(m: Machine, args: Args) -> Iterator[None]:
    items, tail = split_list(args[0])
    wanted = deref(args[1])
    if not isinstance(wanted, Var) and whole(wanted, "length/2") < 0:
        raise RuleFault("a list cannot have less than 0 elements")
    if isinstance(tail, Var):
        yield from _longer(m, len(items), tail, wanted)
    elif tail != "[]":
        raise RuleFault("length/2 needs a list")
    elif m.unify(wanted, len(items)):
        yield


def _longer(m: Machine, count: int, tail: Var, wanted: Term) -> Iterator[None]:
    """Make a list without an end as long as wanted, or longer and longer."""
    if wanted is tail:
        return  # no list is its own length
    if isinstance(wanted, int):
        if wanted - count > _MOST:
            raise RuleFault(f"a list of {wanted} elements is too long")
        m.charge(max(wanted - count, 0))
        if wanted >= count and m.unify(tail, _fresh(wanted - count)):
            yield
        return
    number = 0
    while number < _MOST:
        mark = len(m.trail)
        m.charge(number)
        if m.unify(tail, _fresh(number)) and m.unify(wanted, count + number):
            yield
        undo(m.trail, mark)
        number += 1


def _fresh(count: int) -> Term:
    return make_list([Var() for _ in range(count)])


def _msort(m: Machine, args: Args) -> bool:
    return m.unify(args[1], make_list(in_order(_to_sort(m, args[0], "msort/2"))))


def _sort(m: Machine, args: Args) -> bool:
    return m.unify(args[1], make_list(once_each(_to_sort(m, args[0], "sort/2"))))


def _to_sort(m: Machine, term: Term, what: str) -> list[Term]:
    """Return the elements of a list, their comparisons counted as work."""
    items = proper_list(term, what)
    m.charge(len(items) * len(items).bit_length() // 4)
    return items


def _sort_by(m: Machine, args: Args) -> bool:
    """Sort by an argument: ``sort(Number, Order, List, Sorted)``; 0 means the whole term."""
    number, order = whole(args[0], "sort/4"), deref(args[1])
    if order not in ("@<", "@=<", "@>", "@>="):
        raise RuleFault("sort/4 needs an order", "one of @<, @=<, @>, @>=")
    items = _to_sort(m, args[2], "sort/4")
    keys = {id(item): _key(item, number) for item in items}
    sign = -1 if order in ("@>", "@>=") else 1

    def by_key(a: Term, b: Term) -> int:
        return sign * compare(keys[id(a)], keys[id(b)])

    ordered = sorted(items, key=cmp_to_key(by_key))
    if order in ("@<", "@>"):
        ordered = [
            item
            for place, item in enumerate(ordered)
            if not place or by_key(ordered[place - 1], item)
        ]
    return m.unify(args[3], make_list(ordered))


def _key(item: Term, number: int) -> Term:
    if number == 0:
        return item
    item = deref(item)
    if not isinstance(item, Struct) or not 1 <= number <= len(item.args):
        raise RuleFault(f"sort/4 needs terms with {number} arguments or more")
    return item.args[number - 1]


def _keysort(m: Machine, args: Args) -> bool:
    pairs = [deref(item) for item in proper_list(args[0], "keysort/2")]
    for pair in pairs:
        if not isinstance(pair, Struct) or pair.name != "-" or len(pair.args) != 2:
            raise RuleFault("keysort/2 needs pairs", "such as: [2-a, 1-b]")
    return _sort_by(m, [1, "@=<", make_list(pairs), args[1]])


TESTS: Mapping[Key, Callable[[Any, Args], bool]] = {
    ("msort", 2): _msort,
    ("sort", 2): _sort,
    ("sort", 4): _sort_by,
    ("keysort", 2): _keysort,
}
SEVERAL: Mapping[Key, Callable[[Any, Args], Iterator[None]]] = {
    ("between", 3): _between,
    ("length", 2): _length,
}
