"""FMEA sheets: one line per failure mode, written as CSV and JSON, read back from CSV."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.names import derive_id
from amberbox.core.redaction import masked_values
from amberbox.core.robot_status import SEVERITIES
from amberbox.diagnosis.fmea.criticality import (
    FmeaCoverage,
    PriorityRule,
    by_risk_number,
    criticalities,
    expected_failures,
    matrix,
    mode_criticality,
    priority,
)
from amberbox.diagnosis.fmea.loader import resolve
from amberbox.diagnosis.fmea.model import FailureMode, Fmea

# Columns of a sheet, in this order
COLUMNS = (
    "Item", "Item description", "Function", "Failure mode", "Description", "Cause",
    "Local effect", "Next effect", "End effect", "Class", "Severity", "S", "O", "D", "RPN",
    "Priority", "Rate (1/h)", "Probability", "Exposure (h)", "Beta", "Cm", "Detection",
    "Undetected because", "Make safe", "Action",
)  # fmt: skip

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def write_sheet(fmea: Fmea, rules: Sequence[PriorityRule] = ()) -> str:
    """Return the sheet as the text of a CSV file."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for mode in fmea.modes.values():
        row = row_of(fmea, mode, rules)
        writer.writerow([_safe(row[column]) for column in COLUMNS])
    return out.getvalue()


def row_of(fmea: Fmea, mode: FailureMode, rules: Sequence[PriorityRule] = ()) -> dict[str, str]:
    """Return a line of the sheet by column."""
    ranks, effects = mode.ranks, mode.effects
    functions = [n for n, f in fmea.functions.items() if mode.component in f.needs.names()]
    return {
        "Item": mode.component,
        "Item description": fmea.components[mode.component].description,
        "Function": _listed(functions),
        "Failure mode": mode.name,
        "Description": mode.description,
        "Cause": mode.cause,
        "Local effect": effects.local,
        "Next effect": _listed(effects.next),
        "End effect": _listed(effects.system),
        "Class": _listed(mode.classes),
        "Severity": mode.severity,
        "S": _number(ranks.severity),
        "O": _number(ranks.occurrence),
        "D": _number(ranks.detection),
        "RPN": _number(ranks.number),
        "Priority": priority(ranks, rules),
        "Rate (1/h)": _number(mode.rate),
        "Probability": _number(mode.probability),
        "Exposure (h)": _number(mode.exposure_h),
        "Beta": _number(mode.beta),
        "Cm": _number(mode_criticality(mode)),
        "Detection": _listed([link.symptom for link in mode.symptoms]),
        "Undetected because": mode.unobservable,
        "Make safe": mode.make_safe,
        "Action": mode.remedy,
    }


def _listed(names: Sequence[str]) -> str:
    return "; ".join(names)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.12g}"


def _safe(cell: str) -> str:
    """Keep spreadsheets from taking a text for a formula."""
    return f"'{cell}" if cell.startswith(_FORMULA) else cell


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
    """Return the text of a ``fmea.yaml`` with the content of a sheet.

    Errors of the sheet are added to the problems. End effects become functions that need every
    component with that effect, since a sheet has no redundancy.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        problems.append(Problem(str(path), 1, "file", f"cannot be read: {error}"))
        return ""
    delimiter = max(",;\t", key=text.partition("\n")[0].count)
    lines = csv.reader(text.splitlines(keepends=True), delimiter=delimiter)
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
            self._report(line, "Item", "a line needs an item and a failure mode")
            return
        component = self._types.setdefault(item, {"failure_modes": {}})
        description = row.get("Item description") or (row["Item"] if row["Item"] != item else "")
        if description:
            component.setdefault("description", description)
        if name in component["failure_modes"]:
            self._report(line, "Failure mode", f"{item} has '{row['Failure mode']}' twice")
            return
        _take_ranks(row)
        component["failure_modes"][name] = dict(self._mode(row, name, line))
        self._use(item, row)

    def _mode(self, row: Row, name: str, line: int) -> Iterator[tuple[str, Any]]:
        written = row["Failure mode"]
        description = row.get("Description") or (written if written != name else "")
        yield from _given(description=description, cause=row.get("Cause", ""))
        yield from _given(**{"class": self._classes(row, line)})
        word = row.get("Severity", "").lower()
        if word in SEVERITIES:
            yield "severity", word
        elif word:
            near = did_you_mean(word, SEVERITIES)
            self._report(line, "Severity", f"'{word}' is none of {', '.join(SEVERITIES)}{near}")
        yield from self._chance(row, line)
        effects = {"local": row.get("Local effect", "")}
        yield from _given(effects=dict(_given(**effects)))
        entries = _entries(row.get("Detection", ""))
        addresses = [entry for entry in entries if _ADDRESS.fullmatch(entry)]
        others = [entry for entry in entries if entry not in addresses]
        if addresses:
            yield "symptoms", addresses
        else:
            reasons = [row.get("Undetected because", ""), *others]
            yield "unobservable", "; ".join(filter(None, reasons)) or "the sheet names no monitor"
        yield from _given(make_safe=row.get("Make safe", ""), remedy=row.get("Action", ""))

    def _classes(self, row: Row, line: int) -> list[str]:
        found = []
        for word in _entries(row.get("Class", "")):
            try:
                found.append(resolve(word))
            except ValueError as error:
                self._report(line, "Class", str(error), is_error=False)
        return found

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
            self._report(line, "O", "how probable is it? give O, Rate (1/h) or Probability")

    def _number(self, row: Row, key: str, line: int) -> float | None:
        text = row.get(key, "")
        if not text:
            return None
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            self._report(line, key, f"'{text}' is no number")
            return None
        if key in _RANKS and number != int(number):
            self._report(line, key, f"{text} is no whole number")
            return None
        return number

    def _rate(self, row: Row, rate: float | None, line: int) -> float | None:
        """Return the mode's share of its component's rate, where the sheet has one."""
        ratio = self._number(row, "Ratio", line)
        if ratio is None or rate is None:
            return rate
        if not 0 <= ratio <= 1:
            self._report(line, "Ratio", f"{ratio:g} is no share from 0 to 1")
        return rate * ratio

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

    def _report(self, line: int, where: str, what: str, *, is_error: bool = True) -> None:
        self._problems.append(Problem(self._file, line, where, what, is_error=is_error))

    def text(self) -> str:
        """Return everything as YAML."""
        functions = {}
        for name, users in self._functions.items():
            if name not in self._types:
                word = self._words[name] if self._words[name] != name else ""
                given = _given(description=word, needs=users, system=name in self._system)
                functions[name] = dict(given)
        content: dict[str, Any] = {"types": self._types}
        known = {"rate", "probability"}
        modes = [m for of in self._types.values() for m in of["failure_modes"].values()]
        if any("o" in m.get("ranks", {}) and not known & m.keys() for m in modes):
            content = {"scales": {"occurrence": _OCCURRENCE}, **content}
            what = "O is taken for failures per hour in powers of ten: put your own into 'scales'"
            self._report(1, "O", what, is_error=False)
        content |= {"functions": functions} if functions else {}
        text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100)
        return text


_NUMBERS = {
    "Rate (1/h)": "rate", "Probability": "probability", "Exposure (h)": "exposure_h",
    "Beta": "beta", "S": "s", "O": "o", "D": "d",
}  # fmt: skip
_RANKS = {"S": "s", "O": "o", "D": "d"}
_OCCURRENCE = {str(rank): float(f"1e-{11 - rank}") for rank in range(1, 11)}


def _take_ranks(row: Row) -> None:
    """Use numbers under Severity and Detection as ranks."""
    for name, rank in (("Severity", "S"), ("Detection", "D")):
        if _WHOLE.fullmatch(row.get(name, "")):
            number = row.pop(name)
            row[rank] = row.get(rank) or number


def _entries(cell: str) -> list[str]:
    return [part.strip() for part in cell.split(";") if part.strip()]


def _given(**values: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values that are not empty."""
    return ((key, value) for key, value in values.items() if value)


def table_json(fmea: Fmea, rules: Sequence[PriorityRule] = ()) -> list[dict[str, str]]:
    """Return the rows of the sheet, the highest S x O x D first."""
    return [row_of(fmea, mode, list(rules)) for mode in by_risk_number(fmea.modes.values())]


def criticality_json(
    fmea: Fmea, exposure_h: float | None = None, rules: Sequence[PriorityRule] = ()
) -> dict[str, Any]:
    """Return C_m of modes, C_r of components and the matrix."""
    modes = sorted(fmea.modes.values(), key=lambda mode: -mode_criticality(mode, exposure_h))
    sums, cells = criticalities(fmea, exposure_h), matrix(fmea, exposure_h)
    return {
        "exposure_h": fmea.exposure_h if exposure_h is None else exposure_h,
        "modes": [_mode(mode, exposure_h, rules) for mode in modes],
        "components": [{"component": name, "C_r": value} for name, value in sums.items()],
        "matrix": [
            {"occurrence": level, "severity": word, "modes": list(ids)}
            for (level, word), ids in cells.cells.items()
        ],
    }


def coverage_json(found: FmeaCoverage) -> dict[str, Any]:
    """Return modes without symptom, symptoms without mode, and modes with the same symptoms."""
    return {
        "modes": found.modes,
        "distinct": found.distinct,
        "unseen": found.unseen,
        "unexplained": list(found.unexplained),
        "alike": [masked_values(group) for group in found.ambiguous],
        "weak": found.weak,
    }


def _mode(
    mode: FailureMode, exposure_h: float | None, rules: Sequence[PriorityRule]
) -> dict[str, Any]:
    return {
        "mode": mode.id,
        "severity": mode.severity,
        "expected": expected_failures(mode, exposure_h),
        "beta": mode.beta,
        "C_m": mode_criticality(mode, exposure_h),
        "RPN": mode.ranks.number,
        "priority": priority(mode.ranks, list(rules)),
    }
