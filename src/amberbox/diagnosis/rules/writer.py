"""Write terms as Prolog reads them: quoted where needed, operators between their operands."""

from __future__ import annotations

import re
from collections.abc import Callable

from amberbox.diagnosis.rules.operators import INFIX, PREFIX
from amberbox.diagnosis.rules.terms import (
    NIL,
    PAIR,
    Real,
    Struct,
    Term,
    Text,
    Var,
    deref,
    split_list,
)

_PLAIN = re.compile(r"[^\W\d_A-Z]\w*|[-+*/\\^<>=~:.?@#&$]+|\[\]|[!;]|\{\}")
_ESCAPES = {"\n": "\\n", "\t": "\\t", "\r": "\\r", "\\": "\\\\", "\0": "\\0\\"}
_ALPHA = re.compile(r"\w+")

Names = Callable[[Var], str]


def anonymous(_variable: Var) -> str:
    """Write every free variable as ``_``."""
    return "_"


def write(term: Term, names: Names = anonymous, *, quoted: bool = True, most: int = 1200) -> str:
    """Write a term; ``names`` gives its free variables names."""
    return _Writer(names, quoted).term(term, most)


def atom(text: str) -> str:
    """Write an atom, in quotes where it needs them."""
    return text if _PLAIN.fullmatch(text) else _quote(text, "'")


def number(value: int | Real) -> str:
    """Write a number as SWI-Prolog does: a float always has a point."""
    if isinstance(value, int):
        return str(value)
    text = f"{float(value):.15g}"
    if float(text) != value:
        text = repr(float(value))
    mantissa, sign, exponent = text.partition("e")
    if "inf" in text or "nan" in text:
        return text
    if not sign and "." not in mantissa:
        return f"{mantissa}.0"
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if sign else text


def _quote(text: str, sign: str) -> str:
    escapes = _ESCAPES | {sign: f"\\{sign}"}
    return sign + "".join(escapes.get(part, part) for part in text) + sign


class _Writer:
    def __init__(self, names: Names, quoted: bool) -> None:
        self.names = names
        self.quoted = quoted

    def term(self, term: Term, most: int) -> str:
        term = deref(term)
        if isinstance(term, Struct):
            return self._struct(term, most)
        if isinstance(term, str):
            text = self._atom(term)
            is_operand = most not in (999, 1200)
            return f"({text})" if is_operand and (term in INFIX or term in PREFIX) else text
        if isinstance(term, Var):
            return self.names(term)
        if isinstance(term, Text):
            return _quote(term.value, '"') if self.quoted else term.value
        return number(term) if isinstance(term, int | Real) else "_"

    def _atom(self, text: str) -> str:
        return atom(text) if self.quoted else text

    def _struct(self, term: Struct, most: int) -> str:
        name, args = term.name, term.args
        if name == PAIR and len(args) == 2:
            return self._list(term)
        if name == "{}" and len(args) == 1:
            return f"{{{self.term(args[0], 1200)}}}"
        if len(args) == 2 and name in INFIX:
            return self._infix(term, most)
        if len(args) == 1 and name in PREFIX and not isinstance(deref(args[0]), int | Real):
            return self._prefix(term, most)
        inner = ",".join(self.term(arg, 999) for arg in args)
        functor = f"'{name}'" if name in (NIL, "{}") and self.quoted else self._atom(name)
        return f"{functor}({inner})"

    def _list(self, term: Struct) -> str:
        items, tail = split_list(term)
        inner = ",".join(self.term(item, 999) for item in items)
        return f"[{inner}]" if tail == NIL else f"[{inner}|{self.term(tail, 999)}]"

    def _infix(self, term: Struct, most: int) -> str:
        operator = INFIX[term.name]
        left = self.term(term.args[0], operator.left)
        right = self.term(term.args[1], operator.right)
        sign = self._atom(term.name)
        if term.name == ",":
            text = f"{left},{right}"
        elif term.name in ("->", ":-", "*->", "-->") or _ALPHA.fullmatch(sign):
            text = f"{left} {sign} {right}"
        else:
            text = _glued(_glued(left, sign), right)
        return f"({text})" if operator.priority > most else text

    def _prefix(self, term: Struct, most: int) -> str:
        operator = PREFIX[term.name]
        inner = self.term(term.args[0], operator.right)
        text = _glued(self._atom(term.name), inner)
        if inner[0] == "(" or (term.name in "+-" and inner[0].isdigit()):
            text = f"{term.name} {inner}"
        return f"({text})" if operator.priority > most else text


def _glued(left: str, right: str) -> str:
    """Join two words, with a blank where they would become one."""
    before, after = left[-1:], right[:1]
    same = any(
        pattern.match(before) and pattern.match(after) for pattern in (_ALPHA, _SYMBOL, _QUOTE)
    )
    return f"{left} {right}" if same else left + right


_SYMBOL = re.compile(r"[-+*/\\^<>=~:.?@#&$]")
_QUOTE = re.compile(r"'")
