"""What of a diagnosis shows still: active causes and cleared ones, and what matters most."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.core.types import Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.covering.prediction import predict
from amberbox.diagnosis.fmea.model import Severity
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import presence

OWN_SHARE = 0.5
"""A symptom is one of a cause that shows it at least so surely as the surest one beside it."""
WEIGHTS: Mapping[Severity, float] = {"warning": 1.0, "urgent": 2.0, "critical": 4.0, "fatal": 8.0}
"""How bad a cause is: its symptoms are told in order of this times its probability."""


@dataclass(frozen=True, slots=True)
class Activity:
    """Which failure modes show no more, since when, and how much each symptom matters."""

    cleared: Mapping[str, int]
    weights: Mapping[str, float]

    @classmethod
    def of(
        cls, knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Iterable[Symptom]
    ) -> Activity:
        """Compare what hypotheses explain with what is there still.

        A cause is cleared when all that it shows is gone; one that comes and goes by its nature
        never is, nor is anything of a diagnosis that is over as a whole.
        """
        shown = _shown(knowledge, diagnosis.hypotheses)
        gone = {s.id: s.gone_ns for s in symptoms if s.gone_ns is not None}
        cleared = _cleared(knowledge, shown, gone) if diagnosis.state == "open" else {}
        return cls(cleared, _weights(knowledge, diagnosis.hypotheses, shown))

    def active(self, hypothesis: Hypothesis) -> Hypothesis:
        """Return a hypothesis with what is active of it; as it is if nothing of it is."""
        left = hypothesis.faults - frozenset(self.cleared)
        return replace(hypothesis, faults=left) if left else hypothesis


def _shown(knowledge: Knowledge, hypotheses: Sequence[Hypothesis]) -> dict[str, set[str]]:
    """Return by failure mode the symptoms that it shows in any of the hypotheses."""
    detects = {f: _detects(knowledge, f) for h in hypotheses for f in h.faults}
    shown: dict[str, set[str]] = {fault: set() for fault in detects}
    for hypothesis in hypotheses:
        for symptom in hypothesis.explains:
            for fault in _owners(symptom, hypothesis.faults, detects):
                shown[fault].add(symptom)
    return shown


def _detects(knowledge: Knowledge, fault: str) -> Mapping[str, float]:
    """Return how surely a failure mode shows each symptom, directly or by what it costs."""
    model = knowledge.model
    if fault == UNKNOWN or fault not in model.mode_places:
        return {}
    misses = predict(model, [fault]).misses
    return {model.signs[place].id: 1.0 - miss for place, miss in misses.items()}


def _owners(
    symptom: str, faults: Iterable[str], detects: Mapping[str, Mapping[str, float]]
) -> Iterator[str]:
    """Yield those of some failure modes that show a symptom; all where none does alone."""
    chances = {fault: detects[fault].get(symptom, 0.0) for fault in faults}
    best = max(chances.values(), default=0.0)
    return (fault for fault, chance in chances.items() if chance >= OWN_SHARE * best)


def _cleared(
    knowledge: Knowledge, shown: Mapping[str, set[str]], gone: Mapping[str, int]
) -> dict[str, int]:
    modes, found = knowledge.fmea.modes, {}
    for fault, symptoms in shown.items():
        comes_and_goes = fault in modes and modes[fault].intermittent
        if symptoms and symptoms <= gone.keys() and not comes_and_goes:
            found[fault] = max(gone[symptom] for symptom in symptoms)
    return found


def _weights(
    knowledge: Knowledge, hypotheses: Sequence[Hypothesis], shown: Mapping[str, set[str]]
) -> dict[str, float]:
    """Return by symptom the worst of its causes: its severity times its probability."""
    weights: dict[str, float] = {}
    for fault, share in presence(hypotheses).items():
        mode = knowledge.fmea.modes.get(fault)
        weight = share * (WEIGHTS[mode.severity] if mode else WEIGHTS["urgent"])
        for symptom in shown[fault]:
            weights[symptom] = max(weight, weights.get(symptom, 0.0))
    return weights
