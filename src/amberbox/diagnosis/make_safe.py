"""Actions that make a robot safe before tests and repairs."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

from amberbox.core.robot_status import SEVERITIES, Severity
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.diagnosis.fmea.model import FailureMode, Fmea

# From this probability of being present on a cause is credible; one that leads always is
CREDIBLE: Final = 0.05

DANGEROUS: Final[tuple[Severity, ...]] = ("critical", "fatal")

# How a remedy begins that makes safe, in an FMEA that has no make_safe
_MAKES_SAFE = re.compile(
    r"(switch|turn|power) (it |everything |the \w+ )?off|stop|shut (it )?down|unplug|disconnect"
    r"|keep (away|clear|people)|evacuate|press the emergency stop|block off",
    re.IGNORECASE,
)
_REPAIRS = re.compile(r"(then )?(replace|repair|mend|exchange|change|fit|swap|renew)\b", re.I)
_CLAUSE_ENDS = re.compile(r"\s*[;,.]\s+")


@dataclass(frozen=True, slots=True)
class MakeSafeAction:
    """An action before every test, as worded in the FMEA.

    ``faults`` are the failure modes it protects against, ``probability`` that of the most probable
    of the worst.
    """

    text: str
    faults: tuple[str, ...]
    severity: Severity
    probability: float


def safe_action(mode: FailureMode) -> str:
    """Return what makes a failure mode safe: ``make_safe``, else how its remedy begins.

    A remedy counts up to its first clause that repairs, for dangerous modes alone, and only if
    it begins by switching off, stopping or keeping away.
    """
    if mode.make_safe or mode.severity not in DANGEROUS:
        return mode.make_safe
    return mode.remedy[: _repair_at(mode.remedy)].rstrip(" ;,.")


def repair_action(mode: FailureMode) -> str:
    """Return the repair of a failure mode, without the part that makes it safe."""
    if mode.make_safe or mode.severity not in DANGEROUS:
        return mode.remedy
    return mode.remedy[_repair_at(mode.remedy) :]


def safety_actions(
    fmea: Fmea,
    hypotheses: Sequence[Hypothesis],
    leading: Collection[str],
    cleared: Collection[str] = (),
) -> tuple[MakeSafeAction, ...]:
    """Return the actions against credible causes, the worst and most probable first.

    ``leading`` are the ids of the leading hypotheses, ``cleared`` failure modes whose symptoms have
    all gone; fatal ones among these are still made safe until they are ruled out.
    """
    first = {fault for h in hypotheses if h.id in leading for fault in h.faults}
    found: dict[str, list[tuple[int, float, str]]] = {}
    for name, share in mode_probabilities(hypotheses).items():
        mode = fmea.modes.get(name)
        if mode is None or (name in cleared and mode.severity != "fatal"):
            continue
        action = safe_action(mode) if share >= CREDIBLE or name in first else ""
        if action:
            found.setdefault(action, []).append((SEVERITIES.index(mode.severity), share, name))
    made = [_against(action, sorted(of, reverse=True)) for action, of in found.items()]
    return tuple(sorted(made, key=lambda m: (-SEVERITIES.index(m.severity), -m.probability)))


def with_safety_actions(fmea: Fmea, diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the actions that come before its tests."""
    leading = leading_ids(diagnosis.groups, diagnosis.hypotheses)
    actions = safety_actions(fmea, diagnosis.hypotheses, leading)
    return replace(diagnosis, make_safe=tuple(action.text for action in actions))


def mode_probabilities(hypotheses: Sequence[Hypothesis]) -> dict[str, float]:
    """Return the probability of each failure mode, alone or with others."""
    shares: dict[str, float] = {}
    for hypothesis in hypotheses:
        for fault in sorted(hypothesis.faults):
            shares[fault] = shares.get(fault, 0.0) + hypothesis.probability
    return {name: min(1.0, share) for name, share in shares.items()}


def leading_ids(groups: Sequence[AmbiguityGroup], hypotheses: Sequence[Hypothesis]) -> set[str]:
    """Return the hypotheses that lead: the most probable group, or hypothesis of no group."""
    grouped = {name for g in groups for name in (*g.members, *g.wider)}
    best = max(groups, key=lambda group: group.probability, default=None)
    alone = (h for h in hypotheses if h.id not in grouped)
    single = max(alone, key=lambda h: h.probability, default=None)
    if best is None or (single is not None and single.probability > best.probability):
        return set() if single is None else {single.id}
    return set(best.members)


def _against(action: str, modes: Sequence[tuple[int, float, str]]) -> MakeSafeAction:
    rank, share, _ = modes[0]
    return MakeSafeAction(action, tuple(name for _, _, name in modes), SEVERITIES[rank], share)


def _repair_at(remedy: str) -> int:
    """Return where the part of a remedy that repairs begins; 0 if none of it makes safe."""
    if not _MAKES_SAFE.match(remedy):
        return 0
    ends = (clause.end() for clause in _CLAUSE_ENDS.finditer(remedy))
    return next((end for end in ends if _REPAIRS.match(remedy, end)), len(remedy))
