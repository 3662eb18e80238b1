"""What experts want to know besides: ids, numbers, proofs, one fact per line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from amberbox.core.sureness import percent
from amberbox.core.timetext import format_time
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis


def details_of(
    diagnosis: Diagnosis, found: Sequence[tuple[AmbiguityGroup, Sequence[Hypothesis]]]
) -> tuple[str, ...]:
    """Return ids and numbers of every hypothesis, criticality and proof, and of the search."""
    return tuple(_lines(diagnosis, found))


def _lines(
    diagnosis: Diagnosis, found: Sequence[tuple[AmbiguityGroup, Sequence[Hypothesis]]]
) -> Iterator[str]:
    of = f"revision {diagnosis.revision}, of {format_time(diagnosis.at_ns)}"
    yield f"diagnosis {diagnosis.id}, {of}"
    if diagnosis.config_hash:
        yield f"configuration {diagnosis.config_hash}"
    looked = f"{diagnosis.mass_covered:.6g}"
    yield f"{len(diagnosis.hypotheses)} hypotheses, which hold {looked} of all probability"
    if diagnosis.incomplete:
        yield f"incomplete: {diagnosis.incomplete}"
    for number, (group, members) in enumerate(found, 1):
        yield f"group {number}: {percent(group.probability)}"
        for hypothesis in members:
            yield from _of_hypothesis(hypothesis)
        if group.wider:
            yield f"    the same with faults that leave no trace: {', '.join(group.wider)}"


def _of_hypothesis(hypothesis: Hypothesis) -> Iterator[str]:
    numbers = f"probability {hypothesis.probability:.6g}, criticality {hypothesis.criticality:.3g}"
    yield f"    {hypothesis.id}: {numbers}"
    if hypothesis.proof:
        yield f"        proof: {hypothesis.proof}"
