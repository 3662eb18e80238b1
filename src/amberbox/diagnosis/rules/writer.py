"""Write terms as Prolog reads them: quoted where needed, operators between their operands."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

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


def write(
    term: Term, names: Names = anonymous, *, quoted: bool = True, most: int = 1200,
    longest: int | None = None,
) -> str:  # fmt: skip
    """Write a term; ``names`` gives its free variables names.

    ``longest`` ends a text of more characters with ``...``, however large the term is.
    """
    return _Writer(names, quoted, longest).write(term, most)


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


class _Glued(NamedTuple):
    """An operator: a blank parts it from a neighbour with which it would become one word."""

    text: str
    is_prefix: bool = False


_Open: TypeAlias = "str | _Glued | tuple[Term, int]"
"""What is still to be written: a text, an operator, or a term with its highest priority."""


class _Writer:
    """Writes from left to right with a stack of its own, so that no term is nested too deeply."""

    def __init__(self, names: Names, quoted: bool, longest: int | None) -> None:
        self.names = names
        self.quoted = quoted
        self.longest = longest
        self.out: list[str] = []
        self.glue: _Glued | None = None
        """The operator that was written last, if nothing stands behind it yet."""

    def write(self, term: Term, most: int) -> str:
        todo: list[_Open] = [(term, most)]
        size = 0
        while todo:
            part = todo.pop()
            if isinstance(part, tuple) and not isinstance(part, _Glued):
                todo.extend(reversed(self._parts(*part)))
                continue
            text = part.text if isinstance(part, _Glued) else part
            if not text:
                continue
            glued = isinstance(part, _Glued) and not part.is_prefix
            if self._needs_blank(text, glued=glued):
                self.out.append(" ")
            self.out.append(text)
            self.glue = part if isinstance(part, _Glued) else None
            size += len(text)
            if self.longest is not None and size > self.longest:
                return "".join(self.out)[: self.longest] + "..."
        return "".join(self.out)

    def _needs_blank(self, text: str, *, glued: bool) -> bool:
        before = self.out[-1] if self.out else ""
        last = self.glue
        if last is not None and last.is_prefix:
            negative = last.text in "+-" and text[0].isdigit()
            return text[0] == "(" or negative or _would_join(before, text)
        return (glued or last is not None) and _would_join(before, text)

    def _parts(self, term: Term, most: int) -> list[_Open]:
        """Return what a term is written as."""
        term = deref(term)
        if isinstance(term, Struct):
            return self._struct(term, most)
        if isinstance(term, str):
            text = self._atom(term)
            is_operand = most not in (999, 1200)
            return [f"({text})" if is_operand and (term in INFIX or term in PREFIX) else text]
        if isinstance(term, Var):
            return [self.names(term)]
        if isinstance(term, Text):
            return [_quote(term.value, '"') if self.quoted else term.value]
        return [number(term) if isinstance(term, int | Real) else "_"]

    def _atom(self, text: str) -> str:
        return atom(text) if self.quoted else text

    def _struct(self, term: Struct, most: int) -> list[_Open]:
        name, args = term.name, term.args
        if name == PAIR and len(args) == 2:
            items, tail = split_list(term)
            end: list[_Open] = ["]"] if tail == NIL else ["|", (tail, 999), "]"]
            return ["[", *_with_commas(items), *end]
        if name == "{}" and len(args) == 1:
            return ["{", (args[0], 1200), "}"]
        if len(args) == 2 and name in INFIX:
            return self._infix(term, most)
        if len(args) == 1 and name in PREFIX and not isinstance(deref(args[0]), int | Real):
            operator = PREFIX[name]
            sign = _Glued(self._atom(name), is_prefix=True)
            return _in_brackets([sign, (args[0], operator.right)], operator.priority > most)
        functor = f"'{name}'" if name in (NIL, "{}") and self.quoted else self._atom(name)
        return [f"{functor}(", *_with_commas(args), ")"]

    def _infix(self, term: Struct, most: int) -> list[_Open]:
        operator = INFIX[term.name]
        sign = self._atom(term.name)
        middle: _Open = _Glued(sign)
        if term.name == ",":
            middle = ","
        elif term.name in ("->", ":-", "*->", "-->") or _ALPHA.fullmatch(sign):
            middle = f" {sign} "
        parts: list[_Open] = [(term.args[0], operator.left), middle, (term.args[1], operator.right)]
        return _in_brackets(parts, operator.priority > most)


def _with_commas(items: Sequence[Term]) -> Iterator[_Open]:
    for number, item in enumerate(items):
        if number:
            yield ","
        yield item, 999


def _in_brackets(parts: list[_Open], needed: bool) -> list[_Open]:
    return ["(", *parts, ")"] if needed else parts


def _would_join(left: str, right: str) -> bool:
    """Tell whether two words side by side would be read as one."""
    before, after = left[-1:], right[:1]
    return any(
        pattern.match(before) and pattern.match(after) for pattern in (_ALPHA, _SYMBOL, _QUOTE)
    )


_SYMBOL = re.compile(r"[-+*/\\^<>=~:.?@#&$]")
_QUOTE = re.compile(r"'")
