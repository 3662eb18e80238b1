"""Words of a rule file: names, variables, numbers, quoted texts, brackets, the final dot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Literal, NamedTuple, TypeAlias

from amberbox.diagnosis.rules.faults import RuleFault
from amberbox.diagnosis.rules.terms import Real, Term, Text, make_list

Sort: TypeAlias = Literal["name", "quoted", "var", "value", "punct", "stop", "end"]


class Token(NamedTuple):
    """One word: its sort, its text or value, its place, and what touches it."""

    sort: Sort
    value: Term
    at: int
    after_blank: bool
    opens: bool = False
    """The next character is ``(``: this is the name of a structure."""


_WORDS = re.compile(
    r"""
    (?P<blank>(?:\s+|%[^\n]*|/\*.*?\*/)+)
  | (?P<stop>\.(?=\s|%|\Z))
  | (?P<name>[^\W\d_A-Z]\w*|[-+*/\\^<>=~:.?@\#&$]+|[!;])
  | (?P<var>[A-Z_]\w*)
  | (?P<char>0'(?:\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.|''|[^\\'\n]))
  | (?P<number>0x[0-9a-fA-F]+|0o[0-7]+|0b[01]+
      |\d+(?:_\d+)*(?:\.\d+(?:[eE][-+]?\d+)?|[eE][-+]?\d+)?)
  | (?P<quoted>'(?:[^'\\]|''|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*')
  | (?P<text>"(?:[^"\\]|""|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*")
  | (?P<codes>`(?:[^`\\]|``|\\x[0-9a-fA-F]+\\|\\[0-7]+\\|\\.)*`)
  | (?P<punct>[()\[\]{},|])
    """,
    re.VERBOSE | re.DOTALL,
)
_ESCAPE = re.compile(r"\\(?:x([0-9a-fA-F]+)\\?|([0-7]+)\\?|(\n|.))", re.DOTALL)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v",
            "0": "\0", "e": "\x1b", "s": " ", "\n": ""}  # fmt: skip
_FOREIGN = {
    "'": "a quote (') is missing at the end of a name",
    '"': 'a quote (") is missing at the end of a text',
    "`": "a backtick (`) is missing at the end",
    "/*": "a comment is not closed: */ is missing",
}


def tokens(text: str, at: int = 0) -> Iterator[Token]:
    """Cut a text into words from ``at`` on, the last one of sort ``end``.

    Raises RuleFault where that is impossible.
    """
    blank = True
    length = len(text)
    while at < length:
        match = _WORDS.match(text, at)
        if match is None or (text.startswith("/*", at) and match.lastgroup != "blank"):
            raise _foreign(text, at)
        sort, end = match.lastgroup, match.end()
        if sort == "blank":
            blank = True
        else:
            yield _token(sort or "", match[0], at, blank, text.startswith("(", end))
            blank = False
        at = end
    yield Token("end", "", length, True)


def _token(sort: str, word: str, at: int, blank: bool, opens: bool) -> Token:
    if sort in ("name", "punct", "stop", "var"):
        return Token(sort, word, at, blank, opens)  # type: ignore[arg-type]  # one of Sort
    if sort == "quoted":
        return Token("quoted", _unescape(word, at), at, blank, opens)
    if sort == "text":
        return Token("value", Text(_unescape(word, at)), at, blank)
    if sort == "codes":
        return Token("value", make_list([*map(ord, _unescape(word, at))]), at, blank)
    return Token("value", _number(sort, word, at), at, blank)


def _number(sort: str, word: str, at: int) -> Term:
    if sort == "char":
        inner = word[2:]
        return ord("'" if inner == "''" else _escaped(inner, at))
    if len(word) > 4000:
        raise RuleFault("a number of more than 4,000 digits", at=at)
    if word[:2] in ("0x", "0o", "0b"):
        return int(word, 0)
    if word.replace("_", "").isdigit():
        return int(word.replace("_", ""))
    value = float(word)
    if value == float("inf"):
        raise RuleFault(f"the number {word} is too large", at=at)
    return Real(value)


def _unescape(word: str, at: int) -> str:
    quote, inner = word[0], word[1:-1]
    return _escaped(inner.replace(quote * 2, quote), at)


def _escaped(text: str, at: int) -> str:
    def replaced(match: re.Match[str]) -> str:
        code, octal, sign = match.groups()
        if sign is None:
            value = int(code, 16) if code else int(octal, 8)
            if value > 0x10FFFF:
                raise RuleFault("an escape for no character", at=at)
            return chr(value)
        if sign.isalnum() and sign not in _ESCAPES:
            raise RuleFault(f"the escape \\{sign} is unknown", "a backslash is written \\\\", at)
        return _ESCAPES.get(sign, sign)

    return _ESCAPE.sub(replaced, text)


def _foreign(text: str, at: int) -> RuleFault:
    for sign, hint in _FOREIGN.items():
        if text.startswith(sign, at):
            return RuleFault(f"{sign} is not closed", hint, at)
    return RuleFault(f"the character {text[at]!r} is not understood", at=at)
