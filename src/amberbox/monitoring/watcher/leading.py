"""The leading answer of a diagnosis in a line: which failure mode, or one of which, how sure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

from amberbox.core.sureness import percent, sure_word
from amberbox.core.types import UNKNOWN_FAULT, AmbiguityGroup, Diagnosis, Hypothesis

_NAMED: Final = 3
"""So many of those that nothing tells apart are named; of the others it is said how many."""
_ALSO: Final = 0.05
"""What is less probable than this is not worth a line."""


def leading(diagnosis: Diagnosis) -> tuple[Hypothesis, ...]:
    """Return the most probable hypothesis, and those that nothing known tells from it."""
    if not diagnosis.groups:
        return diagnosis.hypotheses[:1]
    return _members(diagnosis, diagnosis.groups[0])


def cause(diagnosis: Diagnosis) -> str:
    """Say the leading answer, and how sure it is in a word: ``laser#no_power (very likely)``."""
    first = leading(diagnosis)
    if not first:
        return ""
    return one_of([hypothesis.faults for hypothesis in first], share_of(diagnosis))


def one_of(faults: Sequence[Collection[str]], probability: float) -> str:
    """Name sets of faults of which one is meant, and how sure that is in a word."""
    return f"{_either(faults)} ({sure_word(probability)})"


def share_of(diagnosis: Diagnosis) -> float:
    """Return how probable the leading answer is."""
    if diagnosis.groups:
        return diagnosis.groups[0].probability
    return diagnosis.hypotheses[0].probability if diagnosis.hypotheses else 0.0


def in_words(diagnosis: Diagnosis) -> str:
    """Say the leading answer, what else is worth a thought, and what to do next."""
    if diagnosis.state == "healed":
        return "healed"
    groups = [(_members(diagnosis, g), g.probability) for g in diagnosis.groups]
    worth = [f"{either(m)} ({percent(p)})" for m, p in groups[:1]]
    worth += [f"{either(m)} ({percent(p)})" for m, p in groups[1:3] if p >= _ALSO]
    tests = diagnosis.next_tests
    safe = "; ".join(diagnosis.make_safe)
    first = f"; first, make it safe: {safe}" if safe else ""
    next_test = f"; {'then' if safe else 'next'}: {tests[0].text or tests[0].id}" if tests else ""
    return (", or ".join(worth) or "no answer") + first + next_test


def either(hypotheses: Sequence[Hypothesis]) -> str:
    """Name hypotheses of which one is meant."""
    return _either([hypothesis.faults for hypothesis in hypotheses])


def _either(sets: Sequence[Collection[str]]) -> str:
    names = [_name(faults) for faults in sets[:_NAMED]]
    more = len(sets) - len(names)
    return " or ".join([*names, f"one of {more} more"] if more else names)


def _members(diagnosis: Diagnosis, group: AmbiguityGroup) -> tuple[Hypothesis, ...]:
    by_id = {hypothesis.id: hypothesis for hypothesis in diagnosis.hypotheses}
    return tuple(by_id[name] for name in group.members if name in by_id)


def _name(faults: Collection[str]) -> str:
    names = ("not in the FMEA" if fault == UNKNOWN_FAULT else fault for fault in sorted(faults))
    return " + ".join(names) or "a false alarm"
