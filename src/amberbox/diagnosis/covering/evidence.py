"""What is known: symptoms seen and not seen, conflicts, answers to tests; each counted once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from amberbox.core.errors import UsageError
from amberbox.core.types import Symptom, SymptomState
from amberbox.diagnosis.covering.check import Check

Measurement = tuple[str, int, int]
"""An address and the time from and to, in nanoseconds, that was looked at."""


@dataclass(frozen=True, slots=True)
class Observation:
    """The state of a symptom and how far it is to be trusted.

    With probability ``strength`` the observation is right, else it is the toss of a coin: its
    likelihood is ``strength * P(state | faults) + (1 - strength) / 2``.
    """

    state: SymptomState
    strength: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.strength <= 1.0:
            raise UsageError(f"the strength of a symptom is {self.strength:g}, not in (0, 1]")


@dataclass(frozen=True, slots=True)
class Answered:
    """A test and the outcome that it gave."""

    check: Check
    outcome: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """All that is known.

    A conflict is a set of failure modes of which at least one is there. ``asked`` are tests
    that were done or cannot be done: they are not proposed again. ``doubled`` are symptoms that
    do not count, because what they were measured from has been counted. ``onsets_ns`` are when
    present symptoms began, as far as that is known.
    """

    observations: Mapping[str, Observation] = field(default_factory=dict)
    conflicts: tuple[frozenset[str], ...] = ()
    answers: tuple[Answered, ...] = ()
    asked: frozenset[str] = frozenset()
    doubled: tuple[str, ...] = ()
    onsets_ns: Mapping[str, int] = field(default_factory=dict)

    def with_observation(self, symptom: str, state: SymptomState) -> Evidence:
        """Return the evidence after a look at a symptom; unknown means it cannot be told."""
        observations = {name: o for name, o in self.observations.items() if name != symptom}
        return replace(self, observations=observations | {symptom: Observation(state)})


def evidence_of(symptoms: Iterable[Symptom], conflicts: Iterable[Iterable[str]] = ()) -> Evidence:
    """Collect symptoms so that one measurement counts once.

    Of two observations of one symptom the stronger counts; of equally strong ones the one that
    says present. The same holds for symptoms of different sources: one does not count when all
    it was measured from (address and overlapping time) has been counted for another source.
    Symptoms of the same source are different questions to the data, and all count.
    """
    counted: dict[str, Observation] = {}
    spent: dict[str, list[tuple[str, int, int]]] = {}
    doubled: list[str] = []
    onsets_ns: dict[str, int] = {}
    for symptom in sorted(symptoms, key=_strongest_first):
        if symptom.state == "unknown" or symptom.strength <= 0 or symptom.id in counted:
            continue
        if _is_spent(symptom, spent):
            doubled.append(symptom.id)
            continue
        counted[symptom.id] = Observation(symptom.state, min(1.0, symptom.strength))
        onset_ns = symptom.confirmed_ns if symptom.onset_ns is None else symptom.onset_ns
        if symptom.state == "present" and onset_ns is not None:
            onsets_ns[symptom.id] = onset_ns
        for address, from_ns, to_ns in symptom.evidence:
            spent.setdefault(address, []).append((symptom.source, from_ns, to_ns))
    sets = tuple(frozenset(conflict) for conflict in conflicts)
    left_out = tuple(name for name in doubled if name not in counted)
    return Evidence(counted, sets, doubled=left_out, onsets_ns=onsets_ns)


def _strongest_first(symptom: Symptom) -> tuple[float, bool, str, str]:
    return (-symptom.strength, symptom.state != "present", symptom.id, symptom.source)


def _is_spent(symptom: Symptom, spent: Mapping[str, list[tuple[str, int, int]]]) -> bool:
    return bool(symptom.evidence) and all(
        any(
            source != symptom.source and from_ns <= until_ns and since_ns <= to_ns
            for source, since_ns, until_ns in spent.get(address, ())
        )
        for address, from_ns, to_ns in symptom.evidence
    )
