"""Built-in predicates of the rule language: terms, types, arithmetic, texts, lists, sorting."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cmp_to_key, partial
from typing import TYPE_CHECKING, Any, TypeAlias

from amberbox.diagnosis.prolog.syntax import number as number_text
from amberbox.diagnosis.prolog.syntax import read_goal
from amberbox.diagnosis.prolog.terms import (
    NIL,
    Key,
    Real,
    RuleFault,
    Slot,
    Struct,
    Term,
    TextTerm,
    Var,
    args_of,
    compare,
    copy,
    deref,
    free_variables,
    in_order,
    is_atomic,
    is_callable,
    make,
    make_list,
    once_each,
    python_number,
    show_key,
    split_list,
    undo,
    variant,
)

if TYPE_CHECKING:
    from amberbox.diagnosis.prolog.machine import PrologMachine

Number = int | Real
_MOST_BITS = 13_000


def evaluate(term: Term) -> Number:
    """Return the value of an expression; raise RuleFault if it has none."""
    term = deref(term)
    if isinstance(term, int | Real):
        return term
    if isinstance(term, Var | Slot):
        raise RuleFault("a number is needed where a variable has no value yet", _ORDER)
    if isinstance(term, TextTerm):
        return _code(term.value)
    if isinstance(term, str):
        if term not in CONSTANTS:
            raise RuleFault(f"'{term}' is no number", "a number or an expression is needed here")
        return CONSTANTS[term]
    return _apply(term)


def _code(text: str) -> int:
    """Return the code of a text of one character, as SWI-Prolog does."""
    if len(text) != 1:
        raise RuleFault(f'the text "{text}" is no number')
    return ord(text)


_ORDER = "give it a value in a goal before this one"


def _apply(term: Struct) -> Number:
    key = term.name, len(term.args)
    function = FUNCTIONS.get(key)
    if function is None:
        if term.name == "[|]":
            items, _ = split_list(term)
            if len(items) != 1:
                raise RuleFault("a list is no number")
            return evaluate(items[0])
        raise RuleFault(f"there is no arithmetic function {show_key(key)}")
    values = [evaluate(arg) for arg in term.args]
    try:
        value = function(*values)
        if isinstance(value, int):
            if value.bit_length() > _MOST_BITS:
                raise RuleFault("a whole number of more than 4,000 digits")
            return value
        if not math.isfinite(value):
            raise OverflowError
        return Real(value)
    except ZeroDivisionError:
        raise RuleFault("a division by zero") from None
    except (OverflowError, ValueError):
        raise RuleFault(f"{show_key(key)} has no value for {_shown(values)}") from None


def _shown(values: Sequence[Number]) -> str:
    return " and ".join(f"{value:.15g}" for value in values)


def _integers(function: Callable[..., int]) -> Callable[..., int]:
    """Refuse floats."""

    def checked(*values: Number) -> int:
        for value in values:
            if not isinstance(value, int):
                raise RuleFault(f"a whole number is needed, not {value:.15g}")
        return function(*values)

    return checked


def _divide(a: Number, b: Number) -> int | float:
    if isinstance(a, int) and isinstance(b, int):
        return a // b if a % b == 0 else a / b
    return a / b


def _truncated(a: int, b: int) -> int:
    return abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)


def _power(a: Number, b: Number) -> int | float:
    """Compute ``a ** b``: whole numbers stay whole, and a negative exponent gives a float."""
    if isinstance(a, int) and isinstance(b, int):
        return _whole_power(a, b) if b >= 0 or a in (1, -1) else float(a) ** b
    return math.pow(a, b)


def _whole_power(a: int, b: int) -> int:
    if abs(a) > 1 and a.bit_length() * b > 2 * _MOST_BITS:
        raise RuleFault("a whole number of more than 4,000 digits")
    return int(a ** (b if b >= 0 else b % 2))


def _shift(a: int, b: int) -> int:
    if b > _MOST_BITS:
        raise RuleFault("a whole number of more than 4,000 digits")
    return a << b if b >= 0 else a >> -b


def _sign(a: Number) -> int | float:
    if isinstance(a, int):
        return (a > 0) - (a < 0)
    return math.copysign(1.0, a) if a else float(a)


def _round(a: Number) -> int:
    """Round to the nearest whole number, halves away from zero."""
    if isinstance(a, int):
        return a
    fraction, whole = math.modf(a)
    return int(whole) + (int(math.copysign(1, a)) if abs(fraction) >= 0.5 else 0)


def _larger(a: Number, b: Number) -> Number:
    return _float_of(a, b) if python_number(a) == python_number(b) else max(a, b, key=python_number)


def _smaller(a: Number, b: Number) -> Number:
    return _float_of(a, b) if python_number(a) == python_number(b) else min(a, b, key=python_number)


def _float_of(a: Number, b: Number) -> Number:
    """Return that of two equal numbers that is a float, if one is."""
    return a if isinstance(a, Real) else b


CONSTANTS: Mapping[str, Number] = {
    "pi": Real(math.pi), "e": Real(math.e), "epsilon": Real(2.0**-52),
}  # fmt: skip
_ONE: Mapping[str, Callable[..., int | float]] = {
    "-": operator.neg, "+": operator.pos, "abs": abs, "sign": _sign, "float": float,
    "integer": _round, "round": _round, "truncate": math.trunc, "floor": math.floor,
    "ceiling": math.ceil, "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "log2": math.log2,
    "sin": math.sin, "cos": math.cos, "tan": math.tan,
    "asin": math.asin, "acos": math.acos, "atan": math.atan, "\\": _integers(operator.invert),
}  # fmt: skip
_TWO: Mapping[str, Callable[..., int | float]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": _divide, "**": _power,
    "^": _power, "//": _integers(_truncated), "div": _integers(operator.floordiv),
    "mod": _integers(operator.mod), "rem": _integers(lambda a, b: a - b * _truncated(a, b)),
    "min": _smaller, "max": _larger, "gcd": _integers(math.gcd), "atan2": math.atan2,
    "atan": math.atan2, ">>": _integers(lambda a, b: _shift(a, -b)), "<<": _integers(_shift),
    "/\\": _integers(operator.and_), "\\/": _integers(operator.or_),
    "xor": _integers(operator.xor),
}  # fmt: skip
FUNCTIONS: Mapping[Key, Callable[..., int | float]] = {
    **{(name, 1): function for name, function in _ONE.items()},
    **{(name, 2): function for name, function in _TWO.items()},
}


Args: TypeAlias = list[Term]
Test: TypeAlias = "Callable[[PrologMachine, Args], bool]"
Several: TypeAlias = "Callable[[PrologMachine, Args], Iterator[Any]]"
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


def differ(m: PrologMachine, left: Term, right: Term) -> bool:
    """Return whether two terms cannot be made equal; binds nothing."""
    mark = len(m.trail)
    equal = m.unify(left, right)
    undo(m.trail, mark)
    return not equal


def _kind(is_kind: Callable[[Term], bool]) -> Test:
    return lambda m, args: is_kind(deref(args[0]))


def _arithmetic(holds: Callable[[float, float], bool]) -> Test:
    return lambda m, args: holds(python_number(evaluate(args[0])), python_number(evaluate(args[1])))


def _ordered(holds: Callable[[int], bool]) -> Test:
    return lambda m, args: holds(compare(args[0], args[1]))


def _functor(m: PrologMachine, args: Args) -> bool:
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


def _arg(m: PrologMachine, args: Args) -> Iterator[None]:
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


def _univ(m: PrologMachine, args: Args) -> bool:
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


def _occurs(m: PrologMachine, args: Args) -> bool:
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


_TERMS: Mapping[Key, Test] = {
    ("=", 2): lambda m, args: m.unify(args[0], args[1]),
    ("\\=", 2): lambda m, args: differ(m, args[0], args[1]),
    ("unify_with_occurs_check", 2): _occurs,
    ("==", 2): _ordered(lambda sign: sign == 0),
    ("\\==", 2): _ordered(lambda sign: sign != 0),
    ("@<", 2): _ordered(lambda sign: sign < 0),
    ("@=<", 2): _ordered(lambda sign: sign <= 0),
    ("@>", 2): _ordered(lambda sign: sign > 0),
    ("@>=", 2): _ordered(lambda sign: sign >= 0),
    ("compare", 3): lambda m, args: m.unify(args[0], "<=>"[compare(args[1], args[2]) + 1]),
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
    ("string", 1): _kind(lambda term: isinstance(term, TextTerm)),
    ("is_list", 1): _kind(lambda term: split_list(term)[1] == "[]"),
    ("ground", 1): lambda m, args: not free_variables(args[:1]),
    ("functor", 3): _functor,
    ("=..", 2): _univ,
    ("copy_term", 2): lambda m, args: m.unify(args[1], copy(args[0], {})),
    ("term_variables", 2): lambda m, args: m.unify(args[1], make_list(free_variables(args[:1]))),
}


def text_of(term: Term, what: str) -> str:
    """Return the characters of an atom, text or number; raise RuleFault for anything else."""
    found = _text(term)
    if found is None:
        has = "no value yet" if isinstance(deref(term), Var) else "another kind of value"
        raise RuleFault(f"{what} needs an atom or a text and has {has}")
    return found


def _text(term: Term) -> str | None:
    term = deref(term)
    if isinstance(term, str):
        return term
    if isinstance(term, TextTerm):
        return term.value
    return number_text(term) if isinstance(term, int | Real) else None


def parse_number(text: str) -> int | Real | None:
    """Read a number as Prolog writes it, None if it is none."""
    try:
        term = read_goal(text).term
    except RuleFault:
        return None
    return term if isinstance(term, int | Real) else None


def _length(m: PrologMachine, args: Args) -> bool:
    return m.unify(args[1], len(text_of(args[0], "the length of an atom")))


def _concat(make: Callable[[str], Term], what: str, m: PrologMachine, args: Args) -> Iterator[None]:
    """Join two parts to a whole, or cut a whole: ``atom_concat/3``, ``string_concat/3``."""
    left, right = _text(args[0]), _text(args[1])
    if left is not None and right is not None:
        both = m.charge_text(left + right)
        if m.unify(args[2], make(both)) or _text(args[2]) == both:
            yield
        return
    whole = text_of(args[2], what)
    for place in _cuts(whole, left, right):
        m.charge_text(whole)
        mark = len(m.trail)
        pairs = zip(args[:2], (make(whole[:place]), make(whole[place:])), strict=True)
        if all(not isinstance(deref(arg), Var) or m.unify(arg, part) for arg, part in pairs):
            yield
        undo(m.trail, mark)


def _cuts(whole: str, left: str | None, right: str | None) -> Iterable[int]:
    """Return the places at which a text can be cut so that the known part fits."""
    if left is not None:
        return [len(left)] if whole.startswith(left) else []
    if right is not None:
        return [len(whole) - len(right)] if whole.endswith(right) else []
    return range(len(whole) + 1)


def _join(m: PrologMachine, args: Args) -> bool:
    """Join a list with a separator, or cut an atom at each: ``atomic_list_concat/3``."""
    separator = text_of(args[1], "atomic_list_concat/3") if len(args) == 3 else ""
    items, tail = split_list(args[0])
    parts = [_text(item) for item in items]
    if tail == "[]" and all(part is not None for part in parts):
        whole = separator.join(part for part in parts if part is not None)
        return m.unify(args[-1], m.charge_text(whole))
    if not separator:
        raise RuleFault("atomic_list_concat needs a list of values", "or a separator to cut at")
    pieces = m.charge_text(text_of(args[-1], "atomic_list_concat/3")).split(separator)
    m.charge(len(pieces))
    return m.unify(args[0], make_list([*pieces]))


def _parts(make: Callable[[str], Term], what: str, m: PrologMachine, args: Args) -> bool:
    """Take an atom apart, or put it together: ``atom_chars/2``."""
    known = _text(args[0])
    if known is not None:
        m.charge(len(known))
        return m.unify(args[1], make_list([make(sign) for sign in known]))
    return m.unify(args[0], _joined(args[1], what))


def _joined(term: Term, what: str) -> str:
    known = deref(term)
    if isinstance(known, TextTerm):
        return known.value
    signs = [deref(item) for item in proper_list(term, what)]
    for sign in signs:
        if not (isinstance(sign, str) or (isinstance(sign, int) and 0 <= sign <= 0x10FFFF)):
            raise RuleFault(f"{what} needs a list of characters")
    return "".join(chr(sign) if isinstance(sign, int) else str(sign) for sign in signs)


def _char_code(m: PrologMachine, args: Args) -> bool:
    sign = deref(args[0])
    if isinstance(sign, str) and len(sign) == 1:
        return m.unify(args[1], ord(sign))
    return m.unify(sign, _joined(make_list(args[1:]), "char_code/2"))


def _number_codes(m: PrologMachine, args: Args) -> bool:
    known = deref(args[0])
    if isinstance(known, int | Real):
        return m.unify(args[1], make_list([*map(ord, number_text(known))]))
    text = _joined(args[1], "number_codes/2")
    value = parse_number(text)
    if value is None:
        raise RuleFault(f"'{text}' is no number")
    return m.unify(known, value)


def _atom_number(m: PrologMachine, args: Args) -> bool:
    known = _text(args[0])
    if known is None:
        given = deref(args[1])
        if not isinstance(given, int | Real):
            raise RuleFault("atom_number/2 needs an atom or a number")
        return m.unify(args[0], number_text(given))
    value = parse_number(known)
    return value is not None and m.unify(args[1], value)


def _convert(change: Callable[[str], Term], m: PrologMachine, args: Args) -> bool:
    """Change letters, as ``upcase_atom/2`` does."""
    return m.unify(args[1], change(m.charge_text(text_of(args[0], "a change of letters"))))


def _upper(text: str) -> str:
    """Return capital letters; as in SWI-Prolog a letter that has no single one stays (ß)."""
    return "".join(
        next(new for new in (sign.upper(), sign.title(), sign) if len(new) == 1) for sign in text
    )


def _lower(text: str) -> str:
    """Return small letters, one for each letter, as SWI-Prolog does."""
    return "".join(sign.lower()[0] for sign in text)


def _atom_string(m: PrologMachine, args: Args) -> bool:
    known = _text(args[0])
    if known is not None:
        wanted = _text(args[1])
        return wanted == known if wanted is not None else m.unify(args[1], TextTerm(known))
    return m.unify(args[0], text_of(args[1], "atom_string/2"))


def _sub_atom(m: PrologMachine, args: Args) -> Iterator[None]:
    """Find parts: ``sub_atom(Atom, Before, Length, After, Part)``."""
    whole = text_of(args[0], "sub_atom/5")
    part = _text(args[4])
    for start, end in _spans(whole, part, deref(args[1]), deref(args[2]), deref(args[3])):
        m.charge((end - start) // 8)
        mark = len(m.trail)
        numbers = (start, end - start, len(whole) - end)
        found = all(m.unify(arg, value) for arg, value in zip(args[1:4], numbers, strict=True))
        if found and (part is not None or m.unify(args[4], whole[start:end])):
            yield
        undo(m.trail, mark)


def _spans(
    whole: str, part: str | None, before: Term, length: Term, after: Term
) -> Iterator[tuple[int, int]]:
    if part is not None:
        start = whole.find(part)
        while start >= 0:
            yield start, start + len(part)
            start = whole.find(part, start + 1)
        return
    for start in _range(before, len(whole)):
        for count in _range(length, len(whole) - start):
            if not isinstance(after, int) or start + count + after == len(whole):
                yield start, start + count


def _range(known: Term, most: int) -> range:
    if not isinstance(known, int):
        return range(most + 1)
    return range(known, known + 1) if 0 <= known <= most else range(0)


_TEXTS: Mapping[Key, Test] = {
    ("atom_length", 2): _length,
    ("string_length", 2): _length,
    ("atomic_list_concat", 2): _join,
    ("atomic_list_concat", 3): _join,
    ("atom_chars", 2): partial(_parts, str, "atom_chars/2"),
    ("atom_codes", 2): partial(_parts, ord, "atom_codes/2"),
    ("char_code", 2): _char_code,
    ("number_codes", 2): _number_codes,
    ("atom_number", 2): _atom_number,
    ("atom_string", 2): _atom_string,
    ("upcase_atom", 2): partial(_convert, _upper),
    ("downcase_atom", 2): partial(_convert, _lower),
    ("string_upper", 2): partial(_convert, lambda text: TextTerm(_upper(text))),
    ("string_lower", 2): partial(_convert, lambda text: TextTerm(_lower(text))),
}
_MOST = 10_000_000


def _between(m: PrologMachine, args: Args) -> Iterator[None]:
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


def _list_length(m: PrologMachine, args: Args) -> Iterator[None]:
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


def _longer(m: PrologMachine, count: int, tail: Var, wanted: Term) -> Iterator[None]:
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


def _sorted(order: Callable[[Args], Args], what: str, m: PrologMachine, args: Args) -> bool:
    return m.unify(args[1], make_list(order(_to_sort(m, args[0], what))))


def _to_sort(m: PrologMachine, term: Term, what: str) -> list[Term]:
    """Return the elements of a list, their comparisons counted as work."""
    items = proper_list(term, what)
    m.charge(len(items) * len(items).bit_length() // 4)
    return items


def _sort_by(m: PrologMachine, args: Args) -> bool:
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


def _keysort(m: PrologMachine, args: Args) -> bool:
    pairs = [deref(item) for item in proper_list(args[0], "keysort/2")]
    for pair in pairs:
        if not isinstance(pair, Struct) or pair.name != "-" or len(pair.args) != 2:
            raise RuleFault("keysort/2 needs pairs", "such as: [2-a, 1-b]")
    return _sort_by(m, [1, "@=<", make_list(pairs), args[1]])


TESTS: Mapping[Key, Test] = {
    **_TERMS,
    **_TEXTS,
    ("msort", 2): partial(_sorted, in_order, "msort/2"),
    ("sort", 2): partial(_sorted, once_each, "sort/2"),
    ("sort", 4): _sort_by,
    ("keysort", 2): _keysort,
}
SEVERAL: Mapping[Key, Several] = {
    ("arg", 3): _arg,
    ("atom_concat", 3): partial(_concat, str, "atom_concat/3"),
    ("string_concat", 3): partial(_concat, TextTerm, "string_concat/3"),
    ("sub_atom", 5): _sub_atom,
    ("between", 3): _between,
    ("length", 2): _list_length,
}
