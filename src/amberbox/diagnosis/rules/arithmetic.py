"""Arithmetic of ``is`` and the comparisons, with the results that SWI-Prolog gives."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import (
    Key,
    Real,
    Slot,
    Struct,
    Term,
    Text,
    Var,
    deref,
    show_key,
    split_list,
)

Number = int | Real
_MOST_BITS = 13_000


def evaluate(term: Term) -> Number:
    """Return the value of an expression; raise RuleFault if it has none."""
    term = deref(term)
    if isinstance(term, int | Real):
        return term
    if isinstance(term, Var | Slot):
        raise RuleFault("a number is needed where a variable has no value yet", _ORDER)
    if isinstance(term, Text):
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
            return _only_element(term)
        raise RuleFault(f"there is no arithmetic function {show_key(key)}")
    values = [evaluate(arg) for arg in term.args]
    try:
        return _checked(function(*values))
    except ZeroDivisionError:
        raise RuleFault("a division by zero") from None
    except (OverflowError, ValueError):
        raise RuleFault(f"{show_key(key)} has no value for {_shown(values)}") from None


def _shown(values: Sequence[Number]) -> str:
    return " and ".join(f"{value:.15g}" for value in values)


def _only_element(term: Struct) -> Number:
    items, _ = split_list(term)
    if len(items) != 1:
        raise RuleFault("a list is no number")
    return evaluate(items[0])


def _checked(value: float) -> Number:
    if isinstance(value, int):
        if value.bit_length() > _MOST_BITS:
            raise RuleFault("a whole number of more than 4,000 digits")
        return value
    if not math.isfinite(value):
        raise OverflowError
    return Real(value)


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
    return _float_of(a, b) if plain(a) == plain(b) else max(a, b, key=plain)


def _smaller(a: Number, b: Number) -> Number:
    return _float_of(a, b) if plain(a) == plain(b) else min(a, b, key=plain)


def _float_of(a: Number, b: Number) -> Number:
    """Return that of two equal numbers that is a float, if one is."""
    return a if isinstance(a, Real) else b


def plain(number: Number) -> int | float:
    """Return Python's own number, which compares by value."""
    return float(number) if isinstance(number, Real) else number


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
