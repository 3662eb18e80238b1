"""Criticality and coverage: C_m and C_r, S x O x D, priorities, undetected and ambiguous modes."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.errors import Problem
from amberbox.core.robot_status import SEVERITIES
from amberbox.diagnosis.fmea.model import (
    FailureMode,
    Fmea,
    RiskRanks,
    links_by_mode,
    miss_probability,
)

# Levels of occurrence and the share of all failures that they begin at (MIL-STD-1629A)
LEVELS: tuple[tuple[str, float], ...] = (
    ("A frequent", 0.2),
    ("B probable", 0.1),
    ("C occasional", 0.01),
    ("D remote", 0.001),
    ("E unlikely", 0.0),
)


def expected_failures(mode: FailureMode, exposure_h: float | None = None) -> float:
    """Return the expected number of failures within the exposure: alpha x lambda_p x t."""
    if mode.rate is not None:
        return mode.rate * (mode.exposure_h if exposure_h is None else exposure_h)
    chance = mode.probability or 0.0
    return -math.log1p(-chance) if chance < 1 else math.inf


def mode_criticality(mode: FailureMode, exposure_h: float | None = None) -> float:
    """Return C_m of a failure mode."""
    return mode.beta * expected_failures(mode, exposure_h) if mode.beta else 0.0


def criticalities(fmea: Fmea, exposure_h: float | None = None) -> dict[str, float]:
    """Return C_r of each component, from high to low."""
    sums = {
        name: math.fsum(mode_criticality(fmea.modes[mode], exposure_h) for mode in component.modes)
        for name, component in fmea.components.items()
    }
    return dict(sorted(sums.items(), key=lambda entry: -entry[1]))


@dataclass(frozen=True, slots=True)
class CriticalityMatrix:
    """Which failure modes are of what severity (column) and level of occurrence (row)."""

    cells: Mapping[tuple[str, str], tuple[str, ...]]

    @property
    def rows(self) -> tuple[str, ...]:
        """Return the levels of occurrence from high to low."""
        return tuple(level for level, _ in LEVELS)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the severities from low to high."""
        return SEVERITIES


def matrix(fmea: Fmea, exposure_h: float | None = None) -> CriticalityMatrix:
    """Return the criticality matrix: a mode's level is its share of all expected failures."""
    counts = {mode.id: expected_failures(mode, exposure_h) for mode in fmea.modes.values()}
    total = math.fsum(counts.values())
    cells: dict[tuple[str, str], list[str]] = {}
    for mode in fmea.modes.values():
        share = counts[mode.id] / total if total else 0.0
        level = next(level for level, bound in LEVELS if share >= bound)
        cells.setdefault((level, mode.severity), []).append(mode.id)
    return CriticalityMatrix({place: tuple(modes) for place, modes in cells.items()})


def by_risk_number(modes: Iterable[FailureMode]) -> list[FailureMode]:
    """Return the modes by S x O x D from high to low; those without a number are last."""
    return sorted(modes, key=lambda mode: -(mode.ranks.number or 0))


_RANGE = re.compile(r"(\d+)(?:\s*-\s*(\d+))?")


@dataclass(frozen=True, slots=True)
class PriorityRule:
    """Ranges of S, O and D, both ends included, and the priority they give."""

    ranges: tuple[tuple[int, int], ...]
    priority: str


def priority(ranks: RiskRanks, rules: Sequence[PriorityRule]) -> str:
    """Return the priority by the first rule that fits; empty if a rank is missing or none fits."""
    given = (ranks.severity, ranks.occurrence, ranks.detection)
    for rule in rules:
        if all(
            rank is not None and low <= rank <= high
            for rank, (low, high) in zip(given, rule.ranges, strict=True)
        ):
            return rule.priority
    return ""


def load_priorities(path: Path, problems: list[Problem]) -> list[PriorityRule]:
    """Read a table; add its errors to the problems."""
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


def _rule(
    row: dict[str, str], file: str, line: int, problems: list[Problem]
) -> PriorityRule | None:
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
    return PriorityRule(tuple(ranges), word)


# From this probability on a symptom is expected of a failure mode, below it is possible
_EXPECTED = 0.5


@dataclass(frozen=True, slots=True)
class AmbiguousModes:
    """Failure modes that the same symptoms are expected of and possible for.

    ``tests`` distinguish some of them; ``left`` are the groups that no test distinguishes.
    """

    modes: tuple[str, ...]
    symptoms: tuple[str, ...]
    tests: tuple[str, ...]
    left: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class FmeaCoverage:
    """Covered and uncovered failure modes; ``unseen`` has the reason by mode."""

    modes: int
    unseen: dict[str, str]
    unexplained: tuple[str, ...]
    ambiguous: tuple[AmbiguousModes, ...]
    weak: dict[str, float]

    @property
    def distinct(self) -> int:
        """Return the number of signatures: groups of modes that symptoms distinguish."""
        seen = self.modes - len(self.unseen)
        return seen - sum(len(group.modes) - 1 for group in self.ambiguous)


def coverage(fmea: Fmea, watched: Collection[str] = (), weak_below: float = 0.9) -> FmeaCoverage:
    """Compare failure modes with symptoms; ``watched`` are the addresses monitors can alarm on.

    Conditions that only a component's faults of unknown kind show are explained by these, and what
    an explained condition reads as well.
    ``weak`` are modes that even all their symptoms together show with less than ``weak_below``.
    """
    links = links_by_mode(fmea)
    missed = {mode: miss_probability(of) for mode, of in links.items()}
    unseen = {m.id: m.unobservable for m in fmea.modes.values() if missed[m.id] >= 1.0}
    by_signature: dict[frozenset[tuple[str, object]], list[str]] = {}
    for mode, of in links.items():
        if mode not in unseen:
            signature = frozenset(
                (link.symptom, (link.detects >= _EXPECTED, link.size, link.after_s)) for link in of
            )
            by_signature.setdefault(signature, []).append(mode)
    groups = [
        _ambiguous_modes(fmea, modes, {symptom for symptom, _ in signature})
        for signature, modes in by_signature.items()
    ]
    explained = {link.symptom for of in links.values() for link in of}
    explained |= {link.symptom for f in fmea.functions.values() for link in f.symptoms}
    if fmea.other.share:
        explained.update(name for names in fmea.unshown().values() for name in names)
    conditions = (s.condition for name, s in fmea.symptoms.items() if name in explained)
    explained |= {address for one in conditions if one is not None for address in one.addresses()}
    all_symptoms = dict.fromkeys((*watched, *fmea.symptoms))
    return FmeaCoverage(
        len(fmea.modes),
        unseen,
        tuple(symptom for symptom in all_symptoms if symptom not in explained),
        tuple(group for group in groups if len(group.modes) > 1),
        {mode: 1 - share for mode, share in missed.items() if 1 - weak_below < share < 1},
    )


def _ambiguous_modes(
    fmea: Fmea, modes: Sequence[str], signature: Collection[str]
) -> AmbiguousModes:
    """Group modes with one signature by the outcomes of tests for each."""
    answers: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for mode in modes:
        given = {result.test: result.outcome for result in fmea.modes[mode].tests}
        tests = dict.fromkeys(result.test for m in modes for result in fmea.modes[m].tests)
        key = tuple((test, given.get(test, fmea.tests[test].outcomes[0])) for test in tests)
        answers.setdefault(key, []).append(mode)
    useful = _useful_keys(list(answers)) if len(answers) > 1 else ()
    left = tuple(tuple(group) for group in answers.values() if len(group) > 1)
    return AmbiguousModes(tuple(modes), tuple(sorted(signature)), useful, left)


def _useful_keys(keys: Sequence[tuple[tuple[str, str], ...]]) -> tuple[str, ...]:
    """Return the tests whose answers differ between the keys."""
    answers: dict[str, set[str]] = {}
    for key in keys:
        for test, outcome in key:
            answers.setdefault(test, set()).add(outcome)
    return tuple(test for test, outcomes in answers.items() if len(outcomes) > 1)
