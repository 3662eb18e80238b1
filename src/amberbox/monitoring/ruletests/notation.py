"""The compact notation of series in rule tests: ``26x20 20+0.5x10 _x3 nan 'drive'x2``."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from amberbox.core.errors import UsageError

MOST_VALUES = 200_000
HINT = "write values such as 5x20 0+0.1x30 _x10 null nan true 'text' [1, 2]x3"

_TOKEN = re.compile(
    r"""\s*(?P<value>'[^']*'|"[^"]*"|\[[^\]]*\]|[^\s'"\[x+]+?(?:[eE][-+]?\d+)?)
        (?:(?P<step>[-+][0-9.]+(?:[eE][-+]?\d+)?)?x(?P<count>\d+))?(?=\s|$)""",
    re.VERBOSE,
)
_WORDS: dict[str, Any] = {"true": True, "false": False, "null": None}
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf)")


class Absent:
    """No message at this time."""

    def __repr__(self) -> str:
        return "_"


ABSENT: Final = Absent()


@dataclass(frozen=True, slots=True)
class Series:
    """Values, one for each interval; ``ABSENT`` where no message comes."""

    values: tuple[Any, ...]

    @classmethod
    def from_text(cls, text: str) -> Series:
        """Read the notation; raise UsageError for what cannot be read."""
        return cls(tuple(read_series(text)))


def read_series(text: str) -> list[Any]:
    """Return the values of a series, ``ABSENT`` where no message comes.

    Raises UsageError for what cannot be read, and for more than ``MOST_VALUES`` values.
    """
    values: list[Any] = []
    for part in _parts(text.strip()):
        values += part
        if len(values) > MOST_VALUES:
            raise UsageError(f"a series has {MOST_VALUES} values at most", "use a longer interval")
    return values


def _parts(text: str) -> Iterator[list[Any]]:
    at = 0
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            raise _unreadable(text[at:].split()[0])
        at = token.end()
        yield _expanded(token)


def _expanded(token: re.Match[str]) -> list[Any]:
    count = min(int(token["count"] or 1), MOST_VALUES + 1)
    value = _value(token["value"], token[0].strip())
    if token["step"] is None:
        return [value] * count
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _unreadable(token[0].strip())
    return [_stepped(value, token["step"], number) for number in range(count)]


def _stepped(value: float, step: str, number: int) -> float:
    """Add a step some times, without the small errors of decimal fractions."""
    grown = value + _number(step) * number
    return grown if isinstance(grown, int) else round(grown, 12)


def _value(text: str, token: str) -> Any:
    if text == "_":
        return ABSENT
    if text[0] in "'\"":
        return text[1:-1]
    if text[0] == "[":
        return _list(text, token)
    if text in _WORDS:
        return _WORDS[text]
    if _NUMBER.fullmatch(text):
        return _number(text)
    raise _unreadable(token)


def _list(text: str, token: str) -> list[float]:
    words = text[1:-1].replace(",", " ").split()
    if not all(_NUMBER.fullmatch(word) for word in words):
        raise _unreadable(token)
    return [float(word) for word in words]


def _number(text: str) -> int | float:
    return int(text) if text.lstrip("+-").isdigit() else float(text)


def _unreadable(token: str) -> UsageError:
    return UsageError(f"cannot read {token} as a value", HINT)


def shown(value: Any) -> str:
    """Write a value as a person would write it in a test."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return json.dumps(value, ensure_ascii=False)
