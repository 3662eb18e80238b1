"""Words of the expression language: numbers, durations, addresses, operators."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from amberbox.core.expression_tree import Fault, status_address

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
class Token:
    """One word and its place; ``unit`` is what is glued to a number (``5s``)."""

    sort: Sort
    text: str
    at: int
    unit: str = ""


def tokens(text: str) -> Iterator[Token]:
    """Cut a text into words, the last one of sort ``end``; raise Fault where it cannot be."""
    at = 0
    while at < len(text):
        match = _PATTERNS.match(text, at)
        if match is None:
            raise _foreign(text, at)
        if match.lastgroup != "blank":
            yield _token(match, text)
        at = match.end()
    yield Token("end", "", len(text))


def _token(match: re.Match[str], text: str) -> Token:
    at, sort = match.start(), match.lastgroup
    if match["number"]:
        return Token("number", match["number"], at, match["unit"] or "")
    if sort == "text":
        return Token("text", re.sub(r"\\(.)", r"\1", match[0][1:-1]), at)
    if sort == "operator":
        if text.startswith("**", at):
            raise _foreign(text, at)
        return Token("operator", match[0], at)
    if sort == "quoted":
        return _quoted(match)
    if sort == "status":
        return Token("address", status_address(match["subject"].strip("`").strip()), at)
    if sort == "word":
        _refuse_half_path(match, text)
        return Token("word", match[0], at)
    return Token("address", match[0], at)


def _quoted(match: re.Match[str]) -> Token:
    name = match[0][1:-1].strip()
    if not name:
        raise Fault("an address is missing between the backticks", match.start())
    return Token("address", name, match.start())


def _refuse_half_path(match: re.Match[str], text: str) -> None:
    """Refuse ``a/b``, which might be a division or a path."""
    glued = re.compile(r"/[A-Za-z_`]").match(text, match.end())
    if glued and not match[0].endswith("]"):
        hint = "write x / y with blanks to divide; an output is component/mode/output, or `...`"
        raise Fault("'/' without blanks: a division or a path?", match.end(), hint)


def _foreign(text: str, at: int) -> Fault:
    for sign, hint in _FOREIGN.items():
        if text.startswith(sign, at):
            return Fault(f"'{sign}' is not understood", at, hint)
    hint = "put an address with such characters in backticks: `smart-wheel/mode/output`"
    return Fault(f"'{text[at]}' is not understood", at, hint)
