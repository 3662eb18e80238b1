"""Symptoms in words: where, since when, measured from what, and what shows them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from amberbox.core.types import Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.explanation.explanation import Seen, Way
from amberbox.diagnosis.explanation.names import Names
from amberbox.diagnosis.explanation.ways import Ways
from amberbox.diagnosis.explanation.words import NS


@dataclass(frozen=True, slots=True)
class Sights:
    """Speaks of symptoms: what was found of each, and how faults show it."""

    names: Names
    ways: Ways
    found: Mapping[str, tuple[Symptom, ...]]
    first_ns: int | None
    weights: Mapping[str, float]

    @classmethod
    def of(
        cls, names: Names, diagnosis: Diagnosis, symptoms: Iterable[Symptom],
        weights: Mapping[str, float],
    ) -> Sights:  # fmt: skip
        """Sort findings by symptom; time counts from the first symptom of the diagnosis."""
        found: dict[str, list[Symptom]] = {}
        for symptom in symptoms:
            if symptom.state == "present":
                found.setdefault(symptom.id, []).append(symptom)
        known = {name: tuple(sorted(of, key=_order)) for name, of in found.items()}
        counted = {name for h in diagnosis.hypotheses for name in (*h.explains, *h.unexplained)}
        named = counted | set(diagnosis.symptoms)
        onsets = [s.onset_ns for n in named for s in known.get(n, ()) if s.onset_ns is not None]
        return cls(names, Ways.of(names), known, min(onsets, default=None), weights)

    def seen(self, symptom_id: str, hypotheses: Sequence[Hypothesis]) -> Seen:
        """Describe a symptom with the ways in which any of the hypotheses shows it."""
        found = self.found.get(symptom_id, ())
        ways: dict[Way, None] = {}
        for hypothesis in hypotheses:
            ways.update(dict.fromkeys(self.ways.to(symptom_id, hypothesis.faults)))
        onset = found[0].onset_ns if found else None
        reason = next((s.reason for s in found if s.reason), "")
        return Seen(
            symptom_id,
            self.names.symptom(symptom_id, reason),
            next((s.address for s in found if s.address), symptom_id),
            onset,
            None if onset is None or self.first_ns is None else (onset - self.first_ns) / NS,
            tuple(dict.fromkeys(address for s in found for address, _, _ in s.evidence)),
            tuple(ways),
            reason,
            _gone_ns(found),
            self.weights.get(symptom_id, 0.0),
        )

    def in_time(
        self, symptoms: Iterable[str], hypotheses: Sequence[Hypothesis]
    ) -> tuple[Seen, ...]:
        """Describe symptoms in order of onset, those without a time last."""
        seen = [self.seen(name, hypotheses) for name in dict.fromkeys(symptoms)]
        return tuple(sorted(seen, key=lambda s: (s.onset_ns is None, s.onset_ns or 0, s.id)))

    def worst_first(
        self, symptoms: Iterable[str], hypotheses: Sequence[Hypothesis]
    ) -> tuple[Seen, ...]:
        """Describe symptoms: what is there still first, and of that what matters most."""
        seen = self.in_time(symptoms, hypotheses)
        return tuple(sorted(seen, key=lambda s: (s.gone_ns is not None, -round(s.weight, 6))))


def _gone_ns(found: Iterable[Symptom]) -> int | None:
    """Return when the last of some findings of a symptom went, None if one is there still."""
    ends = [symptom.gone_ns for symptom in found]
    known = [end_ns for end_ns in ends if end_ns is not None]
    return max(known) if known and len(known) == len(ends) else None


def _order(symptom: Symptom) -> tuple[bool, int, str]:
    return (symptom.onset_ns is None, symptom.onset_ns or 0, symptom.source)
