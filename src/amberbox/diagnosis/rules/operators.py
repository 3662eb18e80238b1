"""The standard operators of Prolog, with the priorities that SWI-Prolog gives them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Operator(NamedTuple):
    """Priority of an operator and the most that its operands may have."""

    priority: int
    left: int
    right: int
    is_right: bool = False


_INFIX = {
    (1200, "xfx"): ":- -->",
    (1100, "xfy"): "; |",
    (1050, "xfy"): "-> *->",
    (1000, "xfy"): ",",
    (700, "xfx"): "< = =.. =@= \\=@= =:= =< == =\\= > >= @< @=< @> @>= \\= \\== as is",
    (600, "xfy"): ":",
    (500, "yfx"): "+ - /\\ \\/ xor",
    (400, "yfx"): "* / // mod rem div << >> divmod rdiv",
    (200, "xfx"): "**",
    (200, "xfy"): "^",
}
_PREFIX = {
    (1200, "fx"): ":- ?-",
    (1150, "fx"): "dynamic discontiguous initialization meta_predicate multifile table",
    (900, "fy"): "\\+",
    (200, "fy"): "- + \\",
}


def _operator(priority: int, kind: str) -> Operator:
    left = priority if kind[0] == "y" else priority - 1
    right = priority if kind[-1] == "y" else priority - 1
    return Operator(priority, left, right, kind == "xfy")


INFIX: Mapping[str, Operator] = {
    name: _operator(*form) for form, names in _INFIX.items() for name in names.split()
}
PREFIX: Mapping[str, Operator] = {
    name: _operator(*form) for form, names in _PREFIX.items() for name in names.split()
}
