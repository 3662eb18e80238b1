"""Tokens and parser of the expression language (``docs/reference/expressions.md``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from amberbox.core.errors import did_you_mean
from amberbox.core.expressions.tree import (
    AddressNode,
    AgeNode,
    ArithmeticNode,
    CallNode,
    ComparisonNode,
    ConstantNode,
    ExpressionFault,
    ExpressionNode,
    HeldNode,
    LogicNode,
    NegativeNode,
    NotNode,
    WindowNode,
    height,
    kind_of,
    status_address,
)
from amberbox.core.units import TIME_NS, duration_ns

Sort: TypeAlias = Literal["number", "text", "address", "word", "operator", "end"]

KEYWORDS = frozenset({"and", "or", "not", "for", "over", "true", "false", "null"})

_NAME = r"[A-Za-z_][A-Za-z0-9_]*"
_ROBOT = rf"(?:{_NAME}:)?"
_PATTERNS = re.compile(
    rf"""
    (?P<blank>\s+)
  | (?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?P<unit>[A-Za-z_]\w*)?
  | (?P<text>'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*")
  | (?P<quoted>`[^`]*`)
  | (?P<status>status\(\s*(?P<subject>{_ROBOT}{_NAME}(?:/{_NAME})?|`[^`]*`)\s*\))
  | (?P<path>{_ROBOT}{_NAME}/{_NAME}/{_NAME}(?![\w/.\[]))
  | (?P<mode>{_ROBOT}{_NAME}\#{_NAME})
  | (?P<word>{_ROBOT}{_NAME}(?:\.{_NAME})*(?:\[\d+\])*)
  | (?P<operator><=|>=|==|!=|[-<>+*/%(),])
    """,
    re.VERBOSE,
)
_FOREIGN = {
    "&&": "write 'and'",
    "||": "write 'or'",
    "**": "write x * x",
    "=": "write '==' to compare",
    "!": "write 'not'",
    "^": "write x * x",
    "`": "a backtick (`) is missing at the end of an address",
    "'": "a quote (') is missing at the end of a text",
    '"': 'a quote (") is missing at the end of a text',
    "[": "the index of a list is a whole number: ranges[17]",
}


@dataclass(frozen=True, slots=True)
class _Token:
    """One token and its position; ``unit`` is the unit directly after a number (``5s``)."""

    sort: Sort
    text: str
    at: int
    unit: str = ""


def tokens(text: str) -> Iterator[_Token]:
    """Cut a text into words, the last one of sort ``end``; raise Fault where it cannot be."""
    at = 0
    while at < len(text):
        match = _PATTERNS.match(text, at)
        if match is None:
            raise _foreign(text, at)
        if match.lastgroup != "blank":
            yield _token(match, text)
        at = match.end()
    yield _Token("end", "", len(text))


def _token(match: re.Match[str], text: str) -> _Token:
    at, sort = match.start(), match.lastgroup
    if match["number"]:
        return _Token("number", match["number"], at, match["unit"] or "")
    if sort == "text":
        return _Token("text", re.sub(r"\\(.)", r"\1", match[0][1:-1]), at)
    if sort == "operator":
        if text.startswith("**", at):
            raise _foreign(text, at)
        return _Token("operator", match[0], at)
    if sort == "quoted":
        name = match[0][1:-1].strip()
        if not name:
            raise ExpressionFault("an address is missing between the backticks", match.start())
        return _Token("address", name, match.start())
    if sort == "status":
        return _Token("address", status_address(match["subject"].strip("`").strip()), at)
    if sort == "word":
        # Refuse ``a/b``, which might be a division or a path.
        glued = re.compile(r"/[A-Za-z_`]").match(text, match.end())
        if glued and not match[0].endswith("]"):
            hint = "write x / y with blanks to divide; an output is component/mode/output, or `...`"
            raise ExpressionFault("'/' without blanks: a division or a path?", match.end(), hint)
        return _Token("word", match[0], at)
    return _Token("address", match[0], at)


def _foreign(text: str, at: int) -> ExpressionFault:
    for sign, hint in _FOREIGN.items():
        if text.startswith(sign, at):
            return ExpressionFault(f"'{sign}' is not understood", at, hint)
    hint = "put an address with such characters in backticks: `smart-wheel/mode/output`"
    return ExpressionFault(f"'{text[at]}' is not understood", at, hint)


WINDOWED = frozenset({"min", "max", "mean", "std", "rate", "count"})
# fewest and most arguments of functions without a window
ARGUMENTS: dict[str, tuple[int, int]] = {
    **dict.fromkeys(("abs", "sqrt", "sin", "cos", "known"), (1, 1)),
    **dict.fromkeys(("atan2", "bit"), (2, 2)),
    **dict.fromkeys(("min", "max", "median"), (2, 99)),
    "age": (1, 1),
}

FUNCTIONS = frozenset(ARGUMENTS) | WINDOWED

_COMPARISONS = frozenset({"<", "<=", ">", ">=", "==", "!="})
_CONSTANTS: dict[str, bool | None] = {"true": True, "false": False, "null": None}
_LONGEST = 10_000
_DEEPEST = 50
_HIGHEST = 200  # a sum of n terms is a tree of height n: whoever walks it goes so deep


def parse_tree(text: str) -> ExpressionNode:
    """Parse a text to a tree; raise Fault at the first error."""
    if len(text) > _LONGEST:
        raise ExpressionFault(f"is longer than {_LONGEST} characters", 0)
    parser = _Parser(list(tokens(text)))
    tree = parser.either()
    if parser.next.sort != "end":
        raise ExpressionFault(*_unexpected(parser.next))
    if height(tree) > _HIGHEST:
        what = f"has more than {_HIGHEST} terms in a row, or parts within parts"
        raise ExpressionFault(what, 0, "divide it into several conditions")
    return tree


@dataclass
class _Parser:
    """Reads tokens from left to right; one method per level of the grammar."""

    tokens: list[_Token]
    place: int = 0
    depth: int = 0
    bare_for: list[ExpressionNode] = field(default_factory=list)
    """Parts ``x for 5s`` that are not in brackets."""

    @property
    def next(self) -> _Token:
        return self.tokens[self.place]

    def take(self, *texts: str) -> _Token | None:
        """Consume the next token if it is one of these words or operators."""
        token = self.next
        if token.sort not in ("word", "operator") or token.text not in texts:
            return None
        self.place += 1
        return token

    def expect(self, text: str, why: str) -> None:
        """Consume a token that is required here."""
        if not self.take(text):
            raise ExpressionFault(f"expected '{text}' {why}", self.next.at)

    def either(self) -> ExpressionNode:
        return self._joined("or", self._both)

    def _both(self) -> ExpressionNode:
        return self._joined("and", self._negation)

    def _joined(self, word: str, operand: Callable[[], ExpressionNode]) -> ExpressionNode:
        parts = [operand()]
        at = self.next.at
        while joint := self.take(word):
            parts.append(operand())
            self._refuse_bare_for(parts[-1], joint)
        if len(parts) == 1:
            return parts[0]
        return LogicNode(at, word, tuple(_condition(part, f"'{word}'") for part in parts))

    def _negation(self) -> ExpressionNode:
        token = self.take("not")
        if token is None:
            return self._held()
        inner = self._nested(self._negation, token)
        self._refuse_bare_for(inner, token)
        return NotNode(token.at, _condition(inner, "'not'"))

    def _refuse_bare_for(self, part: ExpressionNode, joint: _Token) -> None:
        """Refuse ``a and b for 5s``, which may be read as ``(a and b) for 5s``."""
        if any(part is bare for bare in self.bare_for):
            what = f"'for' after '{joint.text}': does it belong to all or to the last part?"
            raise ExpressionFault(
                what, joint.at, "use brackets: (a and b) for 5s, or a and (b for 5s)"
            )

    def _held(self) -> ExpressionNode:
        inner = self._comparison()
        token = self.take("for")
        if token is None:
            return inner
        held = HeldNode(token.at, _condition(inner, "'for'"), self._duration("for"))
        self.bare_for.append(held)
        return held

    def _comparison(self) -> ExpressionNode:
        operands, operators = [self._sum()], list[_Token]()
        while token := self.take(*_COMPARISONS):
            operators.append(token)
            operands.append(self._sum())
        if not operators:
            return operands[0]
        for left, token, right in zip(operands, operators, operands[1:], strict=False):
            _check_comparison(left, token, right)
        return ComparisonNode(operators[0].at, tuple(o.text for o in operators), tuple(operands))

    def _sum(self) -> ExpressionNode:
        return self._chain(self._product, "+", "-")

    def _product(self) -> ExpressionNode:
        return self._chain(self._signed, "*", "/", "%")

    def _chain(self, operand: Callable[[], ExpressionNode], *signs: str) -> ExpressionNode:
        left = operand()
        while token := self.take(*signs):
            right = operand()
            left, right = (_number(part, f"'{token.text}'") for part in (left, right))
            left = ArithmeticNode(token.at, token.text, left, right)
        return left

    def _signed(self) -> ExpressionNode:
        token = self.take("-", "+")
        if token is None:
            return self._atom()
        inner = _number(self._nested(self._signed, token), f"'{token.text}'")
        return NegativeNode(token.at, inner) if token.text == "-" else inner

    def _nested(self, level: Callable[[], ExpressionNode], token: _Token) -> ExpressionNode:
        self.depth += 1
        if self.depth > _DEEPEST:
            raise ExpressionFault("is nested too deeply", token.at)
        tree = level()
        self.depth -= 1
        return tree

    def _atom(self) -> ExpressionNode:
        token = self.next
        if bracket := self.take("("):
            tree = self._nested(self.either, bracket)
            self.expect(")", "to close the bracket")
            self.bare_for = [bare for bare in self.bare_for if bare is not tree]
            return tree
        if token.sort in ("operator", "end") or token.text in KEYWORDS - _CONSTANTS.keys():
            raise ExpressionFault(*_unexpected(token))
        self.place += 1
        if token.sort == "number":
            return ConstantNode(token.at, _number_value(token))
        if token.sort == "text":
            return ConstantNode(token.at, token.text)
        if token.sort == "word" and token.text in _CONSTANTS:
            return ConstantNode(token.at, _CONSTANTS[token.text])
        if token.sort == "word" and self.take("("):
            return self._nested(lambda: self._call(token), token)
        return AddressNode(token.at, token.text)

    def _call(self, name: _Token) -> ExpressionNode:
        if name.text == "status":
            hint = "such as: status(battery) == 'error', status(battery/temperature) == 'ok'"
            raise ExpressionFault("status takes a component, or component/mode", name.at, hint)
        if name.text not in FUNCTIONS:
            known = ", ".join(sorted(FUNCTIONS))
            what = f"there is no function '{name.text}'{did_you_mean(name.text, FUNCTIONS)}"
            raise ExpressionFault(what, name.at, f"functions: {known}")
        arguments = [] if self.next.text == ")" else [self.either()]
        if arguments and self.take("over"):
            return self._window(name, arguments[0])
        while self.take(","):
            arguments.append(self.either())
        self.expect(")", f"to end {name.text}(...)")
        return _function(name, arguments)

    def _window(self, name: _Token, inner: ExpressionNode) -> ExpressionNode:
        if name.text not in WINDOWED:
            raise ExpressionFault(f"{name.text} takes no 'over'", name.at, f"write {name.text}(x)")
        if name.text != "count":
            _number(inner, name.text)
        over_ns = self._duration("over")
        self.expect(")", f"to end {name.text}(...)")
        return WindowNode(name.at, name.text, inner, over_ns)

    def _duration(self, word: str) -> int:
        token = self.next
        if token.sort != "number":
            raise ExpressionFault(
                f"expected a duration after '{word}'", token.at, f"such as: {word} 5s"
            )
        self.place += 1
        unit = token.unit
        if not unit and self.next.sort == "word" and self.next.text in TIME_NS:
            unit = self.next.text
            self.place += 1
        if not unit:
            hint = f"write {word} {token.text}s for seconds"
            raise ExpressionFault(f"the duration after '{word}' has no unit", token.at, hint)
        return _nanoseconds(token, unit)


def _nanoseconds(token: _Token, unit: str) -> int:
    if unit not in TIME_NS:
        raise ExpressionFault(
            f"'{unit}' is no unit of time", token.at, f"units: {', '.join(TIME_NS)}"
        )
    nanoseconds = duration_ns(token.text, unit)
    if not 0 < nanoseconds < 2**62:
        raise ExpressionFault("a duration must be above 0 and below a century", token.at)
    return nanoseconds


def _number_value(token: _Token) -> int | float:
    if token.unit:
        return _nanoseconds(token, token.unit) / TIME_NS["s"]
    whole = token.text.isdigit() and int(token.text) < 2**63
    return int(token.text) if whole else float(token.text)


def _function(name: _Token, arguments: list[ExpressionNode]) -> ExpressionNode:
    if name.text not in ARGUMENTS or (name.text in WINDOWED and len(arguments) == 1):
        hint = f"write {name.text}(x over 5s)"
        raise ExpressionFault(f"{name.text} needs to know over which time", name.at, hint)
    fewest, most = ARGUMENTS[name.text]
    if not fewest <= len(arguments) <= most:
        count = f"{fewest}" if fewest == most else f"{fewest} or more"
        raise ExpressionFault(f"{name.text} takes {count} arguments, not {len(arguments)}", name.at)
    if name.text == "age":
        inner = arguments[0]
        if not isinstance(inner, AddressNode):
            raise ExpressionFault(
                "age takes an address", inner.at, "such as: age(ros_scan.ranges) > 2s"
            )
        return AgeNode(name.at, inner)
    if name.text != "known":
        arguments = [_number(argument, name.text) for argument in arguments]
    return CallNode(name.at, name.text, tuple(arguments))


def _condition(tree: ExpressionNode, wanted_by: str) -> ExpressionNode:
    kind = kind_of(tree)
    if kind in ("number", "text"):
        hint = "compare it with something, such as: x > 0"
        raise ExpressionFault(f"{wanted_by} needs a condition, this is a {kind}", tree.at, hint)
    return tree


def _number(tree: ExpressionNode, wanted_by: str) -> ExpressionNode:
    if kind_of(tree) == "text":
        raise ExpressionFault(f"{wanted_by} needs a number, this is a text", tree.at)
    return tree


def _check_comparison(left: ExpressionNode, token: _Token, right: ExpressionNode) -> None:
    kinds = {kind_of(left), kind_of(right)}
    for side in (left, right):
        if isinstance(side, ConstantNode) and side.value is None:
            hint = "nothing compares with null; write known(x) or not known(x)"
            raise ExpressionFault("a comparison with null is never true", side.at, hint)
    if "text" in kinds and token.text not in ("==", "!="):
        raise ExpressionFault(
            f"a text has no '{token.text}'", token.at, "compare texts with == or !="
        )
    if "text" in kinds and kinds & {"number", "condition"}:
        raise ExpressionFault("a text never equals a number or a condition", token.at)


def _unexpected(token: _Token) -> tuple[str, int]:
    if token.sort == "end":
        return "something is missing at the end", token.at
    return f"'{token.text}' is not expected here", token.at
