"""Priority tables of the user: which S, O and D call for action first.

Published tables disagree on their bounds, so none is built in. A table is a CSV file with the
columns ``S, O, D, priority``; S, O and D are a rank, a range (``4-6``) or empty for any rank. The
first line that fits counts.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.errors import Problem
from amberbox.diagnosis.fmea.model import Ranks

_RANGE = re.compile(r"(\d+)(?:\s*-\s*(\d+))?")


@dataclass(frozen=True, slots=True)
class Rule:
    """Ranges of S, O and D, both ends included, and the priority they give."""

    ranges: tuple[tuple[int, int], ...]
    priority: str


def priority(ranks: Ranks, rules: Sequence[Rule]) -> str:
    """Return the priority by the first rule that fits; empty if a rank is missing or none fits."""
    given = (ranks.severity, ranks.occurrence, ranks.detection)
    for rule in rules:
        if all(
            rank is not None and low <= rank <= high
            for rank, (low, high) in zip(given, rule.ranges, strict=True)
        ):
            return rule.priority
    return ""


def load_priorities(path: Path, problems: list[Problem]) -> list[Rule]:
    """Read a table; add what is wrong with it to the problems."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        problems.append(Problem(str(path), 1, "file", f"cannot be read: {error.strerror}"))
        return []
    rows = list(csv.reader(text.splitlines()))
    columns = [cell.strip().lower() for cell in rows[0]] if rows else []
    if sorted(columns) != ["d", "o", "priority", "s"]:
        what = "the first line must name the columns S, O, D, priority"
        problems.append(Problem(str(path), 1, "columns", what))
        return []
    rules = []
    for line, row in enumerate(rows[1:], 2):
        if any(cell.strip() for cell in row):
            rule = _rule(dict(zip(columns, row, strict=False)), str(path), line, problems)
            rules += [rule] if rule else []
    return rules


def _rule(row: dict[str, str], file: str, line: int, problems: list[Problem]) -> Rule | None:
    ranges = []
    for key in "sod":
        text = row.get(key, "").strip()
        match = _RANGE.fullmatch(text or "1-10")
        low, high = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= low <= high <= 10:
            what = f"'{text}' is no rank and no range from 1 to 10"
            problems.append(Problem(file, line, key.upper(), what))
            return None
        ranges.append((low, high))
    word = row.get("priority", "").strip()
    if not word:
        problems.append(Problem(file, line, "priority", "is empty"))
        return None
    return Rule(tuple(ranges), word)
