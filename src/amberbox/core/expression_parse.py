"""The grammar of the expression language (``docs/expressions.md``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.core.config import did_you_mean
from amberbox.core.expression_tokens import KEYWORDS, Token, tokens
from amberbox.core.expression_tree import (
    Address,
    Age,
    Arithmetic,
    Call,
    Comparison,
    Constant,
    Fault,
    Held,
    Logic,
    Negative,
    Not,
    Tree,
    Window,
    kind_of,
)
from amberbox.core.units import TIME_NS, duration_ns

WINDOWED = frozenset({"min", "max", "mean", "std", "rate", "count"})
ARGUMENTS: dict[str, tuple[int, int]] = {
    **dict.fromkeys(("abs", "sqrt", "sin", "cos", "known"), (1, 1)),
    **dict.fromkeys(("atan2", "bit"), (2, 2)),
    **dict.fromkeys(("min", "max", "median"), (2, 99)),
    "age": (1, 1),
}
"""Fewest and most arguments of a function without a window."""

FUNCTIONS = frozenset(ARGUMENTS) | WINDOWED

_COMPARISONS = frozenset({"<", "<=", ">", ">=", "==", "!="})
_CONSTANTS: dict[str, bool | None] = {"true": True, "false": False, "null": None}
_LONGEST = 10_000
_DEEPEST = 50


def parse_tree(text: str) -> Tree:
    """Read a text; raise Fault at the first thing that is wrong."""
    if len(text) > _LONGEST:
        raise Fault(f"is longer than {_LONGEST} characters", 0)
    parser = _Parser(list(tokens(text)))
    tree = parser.either()
    if parser.next.sort != "end":
        raise Fault(*_unexpected(parser.next))
    return tree


@dataclass
class _Parser:
    """Reads tokens from left to right; one method per level of the grammar."""

    tokens: list[Token]
    place: int = 0
    depth: int = 0
    bare_for: list[Tree] = field(default_factory=list)
    """Parts ``x for 5s`` that stand without brackets."""

    @property
    def next(self) -> Token:
        return self.tokens[self.place]

    def take(self, *texts: str) -> Token | None:
        """Consume the next token if it is one of these words or operators."""
        token = self.next
        if token.sort not in ("word", "operator") or token.text not in texts:
            return None
        self.place += 1
        return token

    def expect(self, text: str, why: str) -> None:
        """Consume a token that must be here."""
        if not self.take(text):
            raise Fault(f"expected '{text}' {why}", self.next.at)

    def either(self) -> Tree:
        return self._joined("or", self._both)

    def _both(self) -> Tree:
        return self._joined("and", self._negation)

    def _joined(self, word: str, operand: Callable[[], Tree]) -> Tree:
        parts = [operand()]
        at = self.next.at
        while joint := self.take(word):
            parts.append(operand())
            self._refuse_bare_for(parts[-1], joint)
        if len(parts) == 1:
            return parts[0]
        return Logic(at, word, tuple(_condition(part, f"'{word}'") for part in parts))

    def _negation(self) -> Tree:
        token = self.take("not")
        if token is None:
            return self._held()
        inner = self._nested(self._negation, token)
        self._refuse_bare_for(inner, token)
        return Not(token.at, _condition(inner, "'not'"))

    def _refuse_bare_for(self, part: Tree, joint: Token) -> None:
        """Refuse ``a and b for 5s``, which one reader takes for ``(a and b) for 5s``."""
        if any(part is bare for bare in self.bare_for):
            what = f"'for' after '{joint.text}': does it belong to all or to the last part?"
            raise Fault(what, joint.at, "use brackets: (a and b) for 5s, or a and (b for 5s)")

    def _held(self) -> Tree:
        inner = self._comparison()
        token = self.take("for")
        if token is None:
            return inner
        held = Held(token.at, _condition(inner, "'for'"), self._duration("for"))
        self.bare_for.append(held)
        return held

    def _comparison(self) -> Tree:
        operands, operators = [self._sum()], list[Token]()
        while token := self.take(*_COMPARISONS):
            operators.append(token)
            operands.append(self._sum())
        if not operators:
            return operands[0]
        for left, token, right in zip(operands, operators, operands[1:], strict=False):
            _check_comparison(left, token, right)
        return Comparison(operators[0].at, tuple(o.text for o in operators), tuple(operands))

    def _sum(self) -> Tree:
        return self._chain(self._product, "+", "-")

    def _product(self) -> Tree:
        return self._chain(self._signed, "*", "/", "%")

    def _chain(self, operand: Callable[[], Tree], *signs: str) -> Tree:
        left = operand()
        while token := self.take(*signs):
            right = operand()
            left, right = (_number(part, f"'{token.text}'") for part in (left, right))
            left = Arithmetic(token.at, token.text, left, right)
        return left

    def _signed(self) -> Tree:
        token = self.take("-", "+")
        if token is None:
            return self._atom()
        inner = _number(self._nested(self._signed, token), f"'{token.text}'")
        return Negative(token.at, inner) if token.text == "-" else inner

    def _nested(self, level: Callable[[], Tree], token: Token) -> Tree:
        self.depth += 1
        if self.depth > _DEEPEST:
            raise Fault("is nested too deeply", token.at)
        tree = level()
        self.depth -= 1
        return tree

    def _atom(self) -> Tree:
        token = self.next
        if bracket := self.take("("):
            tree = self._nested(self.either, bracket)
            self.expect(")", "to close the bracket")
            self.bare_for = [bare for bare in self.bare_for if bare is not tree]
            return tree
        if token.sort in ("operator", "end") or token.text in KEYWORDS - _CONSTANTS.keys():
            raise Fault(*_unexpected(token))
        self.place += 1
        if token.sort == "number":
            return Constant(token.at, _number_value(token))
        if token.sort == "text":
            return Constant(token.at, token.text)
        return self._named(token)

    def _named(self, token: Token) -> Tree:
        if token.sort == "word" and token.text in _CONSTANTS:
            return Constant(token.at, _CONSTANTS[token.text])
        if token.sort == "word" and self.take("("):
            return self._nested(lambda: self._call(token), token)
        return Address(token.at, token.text)

    def _call(self, name: Token) -> Tree:
        if name.text == "status":
            hint = "such as: status(battery) == 'error', status(battery/temperature) == 'ok'"
            raise Fault("status takes a component, or component/mode", name.at, hint)
        if name.text not in FUNCTIONS:
            known = ", ".join(sorted(FUNCTIONS))
            what = f"there is no function '{name.text}'{did_you_mean(name.text, FUNCTIONS)}"
            raise Fault(what, name.at, f"functions: {known}")
        arguments = [] if self.next.text == ")" else [self.either()]
        if arguments and self.take("over"):
            return self._window(name, arguments[0])
        while self.take(","):
            arguments.append(self.either())
        self.expect(")", f"to end {name.text}(...)")
        return _function(name, arguments)

    def _window(self, name: Token, inner: Tree) -> Tree:
        if name.text not in WINDOWED:
            raise Fault(f"{name.text} takes no 'over'", name.at, f"write {name.text}(x)")
        if name.text != "count":
            _number(inner, name.text)
        over_ns = self._duration("over")
        self.expect(")", f"to end {name.text}(...)")
        return Window(name.at, name.text, inner, over_ns)

    def _duration(self, word: str) -> int:
        token = self.next
        if token.sort != "number":
            raise Fault(f"expected a duration after '{word}'", token.at, f"such as: {word} 5s")
        self.place += 1
        unit = token.unit
        if not unit and self.next.sort == "word" and self.next.text in TIME_NS:
            unit = self.next.text
            self.place += 1
        if not unit:
            hint = f"write {word} {token.text}s for seconds"
            raise Fault(f"the duration after '{word}' has no unit", token.at, hint)
        return _nanoseconds(token, unit)


def _nanoseconds(token: Token, unit: str) -> int:
    if unit not in TIME_NS:
        raise Fault(f"'{unit}' is no unit of time", token.at, f"units: {', '.join(TIME_NS)}")
    nanoseconds = duration_ns(token.text, unit)
    if not 0 < nanoseconds < 2**62:
        raise Fault("a duration must be above 0 and below a century", token.at)
    return nanoseconds


def _number_value(token: Token) -> int | float:
    if token.unit:
        return _nanoseconds(token, token.unit) / TIME_NS["s"]
    whole = token.text.isdigit() and int(token.text) < 2**63
    return int(token.text) if whole else float(token.text)


def _function(name: Token, arguments: list[Tree]) -> Tree:
    if name.text not in ARGUMENTS or (name.text in WINDOWED and len(arguments) == 1):
        hint = f"write {name.text}(x over 5s)"
        raise Fault(f"{name.text} needs to know over which time", name.at, hint)
    fewest, most = ARGUMENTS[name.text]
    if not fewest <= len(arguments) <= most:
        count = f"{fewest}" if fewest == most else f"{fewest} or more"
        raise Fault(f"{name.text} takes {count} arguments, not {len(arguments)}", name.at)
    if name.text == "age":
        return _age(name, arguments[0])
    if name.text != "known":
        arguments = [_number(argument, name.text) for argument in arguments]
    return Call(name.at, name.text, tuple(arguments))


def _age(name: Token, inner: Tree) -> Tree:
    if not isinstance(inner, Address):
        raise Fault("age takes an address", inner.at, "such as: age(ros_scan.ranges) > 2s")
    return Age(name.at, inner)


def _condition(tree: Tree, wanted_by: str) -> Tree:
    kind = kind_of(tree)
    if kind in ("number", "text"):
        hint = "compare it with something, such as: x > 0"
        raise Fault(f"{wanted_by} needs a condition, this is a {kind}", tree.at, hint)
    return tree


def _number(tree: Tree, wanted_by: str) -> Tree:
    if kind_of(tree) == "text":
        raise Fault(f"{wanted_by} needs a number, this is a text", tree.at)
    return tree


def _check_comparison(left: Tree, token: Token, right: Tree) -> None:
    kinds = {kind_of(left), kind_of(right)}
    for side in (left, right):
        if isinstance(side, Constant) and side.value is None:
            hint = "nothing compares with null; write known(x) or not known(x)"
            raise Fault("a comparison with null is never true", side.at, hint)
    if "text" in kinds and token.text not in ("==", "!="):
        raise Fault(f"a text has no '{token.text}'", token.at, "compare texts with == or !=")
    if "text" in kinds and kinds & {"number", "condition"}:
        raise Fault("a text never equals a number or a condition", token.at)


def _unexpected(token: Token) -> tuple[str, int]:
    if token.sort == "end":
        return "something is missing at the end", token.at
    return f"'{token.text}' is not expected here", token.at
