"""What monitors make of the failure modes: which nobody sees, which look the same."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.propagation import links_by_mode

_EXPECTED = 0.5
"""From this probability on a symptom is expected of a failure mode, below it is possible."""


@dataclass(frozen=True, slots=True)
class Alike:
    """Failure modes that the same symptoms are expected of and possible for.

    ``tests`` tell some of them apart; ``left`` are those that no test tells apart either, group
    by group.
    """

    modes: tuple[str, ...]
    symptoms: tuple[str, ...]
    tests: tuple[str, ...]
    left: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Coverage:
    """What is covered and what is not; ``unseen`` has the reason by mode."""

    modes: int
    unseen: dict[str, str]
    unexplained: tuple[str, ...]
    alike: tuple[Alike, ...]
    weak: dict[str, float]

    @property
    def distinct(self) -> int:
        """Count the signatures: groups of modes that symptoms tell apart."""
        seen = self.modes - len(self.unseen)
        return seen - sum(len(group.modes) - 1 for group in self.alike)


def coverage(fmea: Fmea, watched: Collection[str] = (), weak_below: float = 0.9) -> Coverage:
    """Compare failure modes with symptoms; ``watched`` are the addresses monitors can alarm on.

    ``weak`` are modes that even all their symptoms together show with less than ``weak_below``.
    """
    links = links_by_mode(fmea)
    missed = {mode: _missed([link.detects for link in of]) for mode, of in links.items()}
    unseen = {m.id: m.unobservable for m in fmea.modes.values() if missed[m.id] >= 1.0}
    by_signature: dict[frozenset[tuple[str, bool]], list[str]] = {}
    for mode, of in links.items():
        if mode not in unseen:
            signature = frozenset((link.symptom, link.detects >= _EXPECTED) for link in of)
            by_signature.setdefault(signature, []).append(mode)
    groups = [
        _alike(fmea, modes, {symptom for symptom, _ in signature})
        for signature, modes in by_signature.items()
    ]
    explained = {link.symptom for of in links.values() for link in of}
    explained |= {link.symptom for f in fmea.functions.values() for link in f.symptoms}
    all_symptoms = dict.fromkeys((*watched, *fmea.symptoms))
    return Coverage(
        len(fmea.modes),
        unseen,
        tuple(symptom for symptom in all_symptoms if symptom not in explained),
        tuple(group for group in groups if len(group.modes) > 1),
        {mode: 1 - share for mode, share in missed.items() if 1 - weak_below < share < 1},
    )


def _alike(fmea: Fmea, modes: Sequence[str], signature: Collection[str]) -> Alike:
    """Sort modes with one signature by what tests give for each."""
    answers: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for mode in modes:
        given = {result.test: result.outcome for result in fmea.modes[mode].tests}
        tests = dict.fromkeys(result.test for m in modes for result in fmea.modes[m].tests)
        key = tuple((test, given.get(test, fmea.tests[test].outcomes[0])) for test in tests)
        answers.setdefault(key, []).append(mode)
    useful = _telling(list(answers)) if len(answers) > 1 else ()
    left = tuple(tuple(group) for group in answers.values() if len(group) > 1)
    return Alike(tuple(modes), tuple(sorted(signature)), useful, left)


def _telling(keys: Sequence[tuple[tuple[str, str], ...]]) -> tuple[str, ...]:
    """Return the tests whose answers differ between the keys."""
    answers: dict[str, set[str]] = {}
    for key in keys:
        for test, outcome in key:
            answers.setdefault(test, set()).add(outcome)
    return tuple(test for test, outcomes in answers.items() if len(outcomes) > 1)


def _missed(detects: Sequence[float]) -> float:
    share = 1.0
    for chance in detects:
        share *= 1.0 - chance
    return share
