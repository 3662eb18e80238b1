"""What the cells of a column are: whole numbers, numbers, yes or no, lists, text."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_INT = r" *(?:0|[-+]?[1-9][0-9]{0,18}) *"
_SHORT_INT = r"[-+]?(?:0|[1-9][0-9]{0,14})"
_FRACTION = (
    r"[-+]?(?:(?:0|[1-9][0-9]*)\.[0-9]*|\.[0-9]+|(?:0|[1-9][0-9]*)(?=[eE]))(?:[eE][-+]?[0-9]+)?"
)
_WORD = r"[-+]?(?:[nN][aA][nN]|[iI][nN][fF](?:[iI][nN][iI][tT][yY])?)"
_FLOAT = rf" *(?:{_FRACTION}|{_SHORT_INT}|{_WORD}) *"
_COMMA = r" *[-+]?(?:0|[1-9][0-9]*)(?:,[0-9]+)? *"
_BOOL = r" *(?:[tT]rue|TRUE|[fF]alse|FALSE) *"
_PATTERNS = {
    kind: re.compile(rf"(?:(?:{cell})\n)*")
    for kind, cell in (("int", _INT), ("float", _FLOAT), ("bool", _BOOL), ("comma", _COMMA))
}
_INT64 = range(-(2**63), 2**63)
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
WORDS = ("NaN", "Infinity", "-Infinity")
"""How numbers that JSON does not have stand in a list."""


@dataclass
class ColumnKind:
    """What the cells of a column have been so far; empty cells are nothing."""

    name: str
    decimal_comma: bool = False
    seen: set[str] = field(default_factory=set)
    elements: set[str] = field(default_factory=set)

    def observe(self, cells: Sequence[str]) -> None:
        """Look at some more cells."""
        filled = [cell for cell in cells if cell]
        if filled and "text" not in self.seen:
            self.seen.add(self._kind(filled))

    def _kind(self, cells: list[str]) -> str:
        joined = "\n".join(cells) + "\n"
        if joined.count("\n") == len(cells):
            for kind in ("int", "float", "bool"):
                if _PATTERNS[kind].fullmatch(joined) and not self._too_large(kind, cells):
                    return self._checked(kind, cells)
            if self.decimal_comma and _PATTERNS["comma"].fullmatch(joined):
                return "comma"
        return "list" if all(map(self._is_list, cells)) else "text"

    def _too_large(self, kind: str, cells: list[str]) -> bool:
        return kind == "int" and any(len(c) >= 19 and int(c) not in _INT64 for c in cells)

    def _checked(self, kind: str, cells: list[str]) -> str:
        """Tell whole numbers that a float cannot hold from those that it can."""
        long = kind == "int" and max(map(len, cells)) > 15
        return "long" if long and any(abs(int(c)) > 2**53 for c in cells) else kind

    def _is_list(self, cell: str) -> bool:
        if not cell.startswith("["):
            return False
        try:
            value = json.loads(cell)
        except ValueError:
            return False
        self.elements.update(map(_element, value))
        return True

    @property
    def kind(self) -> str:
        """What the column is: one of ``_CONVERTERS``, or empty if no cell is filled."""
        for kind, within in _DECISIONS:
            if self.seen <= within:
                return kind if kind != "list" else self._list_kind()
        return "text"

    def _list_kind(self) -> str:
        allowed: tuple[tuple[str, set[str]], ...] = (
            ("list<int>", {"int"}), ("list<float>", {"int", "float", "word"}),
            ("list<text>", {"text", "word"}), ("list<bool>", {"bool"}),
        )  # fmt: skip
        return next((kind for kind, within in allowed if self.elements <= within), "text")


_DECISIONS: tuple[tuple[str, set[str]], ...] = (
    ("", set()),
    ("int", {"int", "long"}),
    ("float", {"int", "float"}),
    ("comma", {"int", "comma"}),
    ("bool", {"bool"}),
    ("list", {"list"}),
)


def _element(value: Any) -> str:
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int" if value in _INT64 else "other"
    if isinstance(value, float):
        return "float"
    if isinstance(value, str):
        return "word" if value in WORDS else "text"
    return "other"


def convert(kind: str, cells: Sequence[str]) -> Sequence[Any]:
    """Turn the cells of a column into values; an empty cell is None."""
    one = _CONVERTERS[kind]
    return [one(cell) if cell else None for cell in cells]


def _text(cell: str) -> str:
    """Take away the mark that kept a spreadsheet from calculating the text."""
    return cell[1:] if cell[0] == "'" and cell[1:2] in _FORMULA else cell


def _comma(cell: str) -> float:
    return float(cell.replace(",", "."))


def _bool(cell: str) -> bool:
    return cell.strip().lower() == "true"


def _floats(cell: str) -> list[float]:
    return [float(value) for value in json.loads(cell)]


_CONVERTERS: Mapping[str, Callable[[str], Any]] = {
    "": str,
    "int": int,
    "float": float,
    "comma": _comma,
    "bool": _bool,
    "text": _text,
    "list<int>": json.loads,
    "list<float>": _floats,
    "list<text>": json.loads,
    "list<bool>": json.loads,
}
