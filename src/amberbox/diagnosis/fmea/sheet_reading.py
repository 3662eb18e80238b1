"""From an FMEA sheet to ``fmea.yaml``: what a sheet says, in the words of the file."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.ids import derive_id
from amberbox.diagnosis.fmea.model import SEVERITIES
from amberbox.diagnosis.fmea.sheet import COLUMNS
from amberbox.diagnosis.fmea.vocabulary import resolve

_ALIASES = {
    "item/function": "Item", "component": "Item", "part": "Item", "item name": "Item",
    "potential failure mode": "Failure mode", "mode": "Failure mode",
    "potential cause": "Cause", "potential causes": "Cause", "causes": "Cause",
    "potential cause(s)": "Cause", "local effects": "Local effect", "effect": "Local effect",
    "potential effect": "Local effect", "potential effects": "Local effect",
    "potential effect(s)": "Local effect", "next higher effect": "Next effect",
    "next level effect": "Next effect", "system effect": "End effect", "end effects": "End effect",
    "sev": "S", "occ": "O", "det": "D", "occurrence": "O", "detectability": "D",
    "rate": "Rate (1/h)", "failure rate": "Rate (1/h)", "mode ratio": "Ratio", "alpha": "Ratio",
    "failure mode ratio": "Ratio", "effect probability": "Beta",
    "failure effect probability": "Beta", "operating time": "Exposure (h)",
    "operating time (h)": "Exposure (h)",
    "current controls": "Detection", "controls": "Detection", "detection method": "Detection",
    "recommended action": "Action", "recommended actions": "Action", "remedy": "Action",
    "recommended action(s)": "Action",
}  # fmt: skip
_WHOLE = re.compile(r"\d+(\.0*)?")
_ADDRESS = re.compile(r"[^\s/;]+/[^\s/;]+/[^\s/;]+")

Row = dict[str, str]


def read_sheet(path: Path, problems: list[Problem]) -> str:
    """Return the text of a ``fmea.yaml`` that says what a sheet says.

    What is wrong with the sheet is added to the problems. End effects become functions that need
    every component that has them as an effect, for a sheet does not say what is redundant.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        problems.append(Problem(str(path), 1, "file", f"cannot be read: {error}"))
        return ""
    lines = csv.reader(text.splitlines(keepends=True), delimiter=_delimiter(text))
    header = next(lines, [])
    columns = [_column(cell, str(path), problems) for cell in header]
    if not {"Item", "Failure mode"} <= set(columns):
        what = "the first line must name at least the columns Item and Failure mode"
        problems.append(Problem(str(path), 1, "columns", what, f"known: {', '.join(COLUMNS)}"))
        return ""
    content = _Content(str(path), problems)
    for row in lines:
        if any(cell.strip() for cell in row):
            cells = zip(columns, row, strict=False)
            content.add({c: _plain(cell) for c, cell in cells if c}, lines.line_num)
    return content.text()


def _delimiter(text: str) -> str:
    first = text.partition("\n")[0]
    return max(",;\t", key=first.count)


def _plain(cell: str) -> str:
    """Take off the quote that keeps spreadsheets from reading a text as a formula."""
    cell = cell.strip()
    return cell[1:] if cell[:1] == "'" and cell[1:2] in "=+-@" else cell


def _column(cell: str, file: str, problems: list[Problem]) -> str:
    word = cell.strip()
    known = {name.lower(): name for name in COLUMNS} | dict(_ALIASES)
    if word.lower() in known:
        return known[word.lower()]
    what = f"the column '{word}' is not read{did_you_mean(word, COLUMNS)}"
    problems.append(Problem(file, 1, "columns", what, is_error=False))
    return ""


class _Content:
    """Collects the lines of a sheet."""

    def __init__(self, file: str, problems: list[Problem]) -> None:
        self._file = file
        self._problems = problems
        self._types: dict[str, dict[str, Any]] = {}
        self._functions: dict[str, list[str]] = {}
        self._words: dict[str, str] = {}
        self._system: set[str] = set()

    def add(self, row: Row, line: int) -> None:
        """Add one line."""
        item, name = derive_id(row.get("Item", "")), derive_id(row.get("Failure mode", ""))
        if not row.get("Item") or not row.get("Failure mode"):
            self._tell(line, "Item", "a line needs an item and a failure mode")
            return
        component = self._types.setdefault(item, {"failure_modes": {}})
        description = row.get("Item description") or (row["Item"] if row["Item"] != item else "")
        if description:
            component.setdefault("description", description)
        if name in component["failure_modes"]:
            self._tell(line, "Failure mode", f"{item} has '{row['Failure mode']}' twice")
            return
        _take_ranks(row)
        component["failure_modes"][name] = dict(self._mode(row, name, line))
        self._use(item, row)

    def _mode(self, row: Row, name: str, line: int) -> Iterator[tuple[str, Any]]:
        written = row["Failure mode"]
        description = row.get("Description") or (written if written != name else "")
        yield from _given(description=description, cause=row.get("Cause", ""))
        yield from _given(**{"class": self._classes(row, line)})
        yield from self._severity(row, line)
        yield from self._chance(row, line)
        effects = {"local": row.get("Local effect", "")}
        yield from _given(effects=dict(_given(**effects)))
        yield from self._detection(row)
        yield from _given(make_safe=row.get("Make safe", ""), remedy=row.get("Action", ""))

    def _classes(self, row: Row, line: int) -> list[str]:
        found = []
        for word in _entries(row.get("Class", "")):
            try:
                found.append(resolve(word))
            except ValueError as error:
                self._tell(line, "Class", str(error), is_error=False)
        return found

    def _severity(self, row: Row, line: int) -> Iterator[tuple[str, Any]]:
        word = row.get("Severity", "").lower()
        if word in SEVERITIES:
            yield "severity", word
        elif word:
            near = did_you_mean(word, SEVERITIES)
            self._tell(line, "Severity", f"'{word}' is none of {', '.join(SEVERITIES)}{near}")

    def _chance(self, row: Row, line: int) -> Iterator[tuple[str, Any]]:
        numbers = {key: self._number(row, key, line) for key in _NUMBERS}
        numbers["Rate (1/h)"] = self._rate(row, numbers["Rate (1/h)"], line)
        for key, name in _NUMBERS.items():
            if numbers[key] is not None and name in ("rate", "probability", "exposure_h"):
                yield name, numbers[key]
        if numbers["Beta"] not in (None, 1.0):
            yield "beta", numbers["Beta"]
        ranks = {name: int(n) for key, name in _RANKS.items() if (n := numbers[key]) is not None}
        yield from _given(ranks=ranks)
        if all(numbers[key] is None for key in ("Rate (1/h)", "Probability", "O")):
            self._tell(line, "O", "how probable is it? give O, Rate (1/h) or Probability")

    def _number(self, row: Row, key: str, line: int) -> float | None:
        text = row.get(key, "")
        if not text:
            return None
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self._tell(line, key, f"'{text}' is no number")
            return None
        if key in _RANKS and number != int(number):
            self._tell(line, key, f"{text} is no whole number")
            return None
        return number

    def _rate(self, row: Row, rate: float | None, line: int) -> float | None:
        """Return the mode's share of a rate that is its component's, where the sheet says one."""
        ratio = self._number(row, "Ratio", line)
        if ratio is None or rate is None:
            return rate
        if not 0 <= ratio <= 1:
            self._tell(line, "Ratio", f"{ratio:g} is no share from 0 to 1")
        return rate * ratio

    def _detection(self, row: Row) -> Iterator[tuple[str, Any]]:
        entries = _entries(row.get("Detection", ""))
        addresses = [entry for entry in entries if _ADDRESS.fullmatch(entry)]
        others = [entry for entry in entries if entry not in addresses]
        if addresses:
            yield "symptoms", addresses
        else:
            said = [row.get("Undetected because", ""), *others]
            yield "unobservable", "; ".join(filter(None, said)) or "the sheet names no monitor"

    def _use(self, item: str, row: Row) -> None:
        """Note that the functions among the effects need this component."""
        end = _entries(row.get("End effect", ""))
        for word in (*end, *_entries(row.get("Function", ""))):
            name = derive_id(word)
            users = self._functions.setdefault(name, [])
            self._words.setdefault(name, word)
            if item not in users:
                users.append(item)
        self._system.update(derive_id(word) for word in end)

    def _tell(self, line: int, where: str, what: str, *, is_error: bool = True) -> None:
        self._problems.append(Problem(self._file, line, where, what, is_error=is_error))

    def text(self) -> str:
        """Return everything as YAML."""
        functions = {
            name: dict(self._function(name, users))
            for name, users in self._functions.items()
            if name not in self._types
        }
        content: dict[str, Any] = {"types": self._types}
        known = {"rate", "probability"}
        if any("o" in m.get("ranks", {}) and not known & m.keys() for m in self._modes()):
            content = {"scales": {"occurrence": _OCCURRENCE}, **content}
            what = "O is taken for failures per hour in powers of ten: put your own into 'scales'"
            self._tell(1, "O", what, is_error=False)
        content |= {"functions": functions} if functions else {}
        text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100)
        return text

    def _function(self, name: str, users: list[str]) -> Iterator[tuple[str, Any]]:
        return _given(description=self._word(name), needs=users, system=name in self._system)

    def _modes(self) -> Iterator[Mapping[str, Any]]:
        for component in self._types.values():
            yield from component["failure_modes"].values()

    def _word(self, name: str) -> str:
        return self._words[name] if self._words[name] != name else ""


_NUMBERS = {
    "Rate (1/h)": "rate", "Probability": "probability", "Exposure (h)": "exposure_h",
    "Beta": "beta", "S": "s", "O": "o", "D": "d",
}  # fmt: skip
_RANKS = {"S": "s", "O": "o", "D": "d"}
_OCCURRENCE = {str(rank): float(f"1e-{11 - rank}") for rank in range(1, 11)}


def _take_ranks(row: Row) -> None:
    """Take numbers that stand under Severity and Detection for the ranks that they are."""
    for name, rank in (("Severity", "S"), ("Detection", "D")):
        if _WHOLE.fullmatch(row.get(name, "")):
            number = row.pop(name)
            row[rank] = row.get(rank) or number


def _entries(cell: str) -> list[str]:
    return [part.strip() for part in cell.split(";") if part.strip()]


def _given(**values: Any) -> Iterator[tuple[str, Any]]:
    """Yield what is not empty."""
    return ((key, value) for key, value in values.items() if value)
