"""Small models and evidence whose answers can be computed by hand."""

from __future__ import annotations

from amberbox.diagnosis.covering.hypotheses import RankedHypotheses
from amberbox.diagnosis.covering.model import Link, Mode, Model, Sign
from amberbox.diagnosis.covering.observations import Evidence, Observation


def two_causes() -> Model:
    """Make one symptom (leak .1) of a (prior .01, detects .9) and b (prior .02, detects .5)."""
    return Model(
        (Mode("a#x", 0.01), Mode("b#y", 0.02)),
        (Sign("s", 0.1),),
        (Link("a#x", "s", 0.9), Link("b#y", "s", 0.5)),
        unknown=None,
    )


def evidence(present: str = "", absent: str = "") -> Evidence:
    """Observe the symptoms that are named, separated by spaces."""
    seen = {name: Observation("present") for name in present.split()}
    return Evidence(seen | {name: Observation("absent") for name in absent.split()})


def probabilities(answer: RankedHypotheses) -> dict[str, float]:
    """Return the probability of each hypothesis by its id."""
    return {hypothesis.id: hypothesis.probability for hypothesis in answer.hypotheses}
