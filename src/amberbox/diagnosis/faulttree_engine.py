"""Diagnosis by fault trees: the minimal cut sets of what is seen, ranked by the evidence.

Each present symptom is a gate: one of the failure modes that show it, or the loss of a function
that shows it, down the needs of that function. The top event is that all of them come about
together, and at least one failure mode of each conflict is there. Its minimal cut sets are what
can be broken: sets without a fault that could be left out. There are no false alarms among them
and nothing that is not in the FMEA; ``answering.answer`` weighs these, too.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.diagnosis.answering import Effort, Heading
from amberbox.diagnosis.covering.answer import Known
from amberbox.diagnosis.covering.evidence import Evidence, Observation
from amberbox.diagnosis.covering.groups import grouped, signature
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.next_test import next_tests, splitting_test
from amberbox.diagnosis.covering.prediction import Prediction, outcomes, predict
from amberbox.diagnosis.faulttree import Analysis, Budget, analyse
from amberbox.diagnosis.faulttree.closest import ranked
from amberbox.diagnosis.faulttree.formula import Constant, all_of, any_of
from amberbox.diagnosis.faulttree.tree import FaultTree, Gate
from amberbox.diagnosis.fmea.chain import chain
from amberbox.diagnosis.fmea.propagation import lost
from amberbox.diagnosis.fmea.trees import tree_over
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.situation import Situation, evidence

TOP = "all that is seen"
_NODES = 300_000
_BELIEVED = 0.5
_MOST_LOOKED_AT = 2_000


def conclude(
    knowledge: Knowledge, situation: Situation, heading: Heading, effort: Effort | None = None
) -> Diagnosis:
    """Return the diagnosis of a situation by fault trees: a pure function of what is given.

    Probabilities are shares among the cut sets that were looked at; ``mass_covered`` is a lower
    bound of the share of those listed in all cut sets. ``incomplete`` says what was cut off. The
    proof of a hypothesis is the way through the tree, a line per symptom. Raises UsageError for
    answers and conflicts that name what the knowledge does not have.
    """
    effort = effort or Effort()
    known = evidence(knowledge, situation)
    causes = _causes(knowledge, known)
    explains = causes or known.conflicts or not any(map(_believed, known.observations.values()))
    found = _Found()  # of what the FMEA does not know there is no tree
    if explains:
        found = _best(knowledge, known, _tree(knowledge, known, causes), effort)
    hypotheses, groups = _hypotheses(knowledge, known, causes, found)
    checks = tuple(knowledge.checks.values())
    tests = next_tests(knowledge.model, known, hypotheses, checks, most=effort.tests)
    return Diagnosis(
        heading.id,
        heading.revision,
        knowledge.robot,
        heading.at_ns,
        knowledge.config_hash,
        hypotheses,
        found.covered,
        found.incomplete,
        (*_unknown(knowledge, known), *situation.findings),
        tuple(proposal.test for proposal in tests),
        tuple(_split(knowledge, known, hypotheses, group) for group in groups),
        tuple(symptom.id for symptom in situation.present()),
    )


def _unknown(knowledge: Knowledge, known: Evidence) -> Iterator[str]:
    """Yield what was seen that the FMEA does not know."""
    return (name for name in known.observations if name not in knowledge.model.sign_places)


def _causes(knowledge: Knowledge, known: Evidence) -> dict[str, tuple[str, ...]]:
    """Return by present symptom the failure modes and losses that show it.

    If there is only what the FMEA does not know, the component that shows it counts as lost.
    """
    present = [name for name, seen in known.observations.items() if _believed(seen)]
    by_symptom: dict[str, list[str]] = {}
    for link in knowledge.model.links:
        by_symptom.setdefault(link.symptom, []).append(link.cause)
    found = {name: tuple(by_symptom[name]) for name in present if name in by_symptom}
    if found:
        return found
    components = {name: name.partition("/")[0] for name in present}
    return {name: (of,) for name, of in components.items() if of in knowledge.fmea.components}


def _believed(seen: Observation) -> bool:
    """Tell whether a symptom must have a cause; weaker ones only count in the ranking."""
    return seen.state == "present" and seen.strength >= _BELIEVED


def _tree(
    knowledge: Knowledge, known: Evidence, causes: Mapping[str, tuple[str, ...]]
) -> FaultTree:
    """Return the tree whose top is that everything seen comes about together."""
    fewest = _fewest({*causes.values(), *_conflicts(knowledge, known)})
    gates = {
        f"seen {place}": Gate(f"seen {place}", any_of(*names)) for place, names in enumerate(fewest)
    }
    gates[TOP] = Gate(TOP, all_of(*gates) if gates else Constant(True))
    return tree_over(knowledge.fmea, TOP, gates, knowledge.exposure_h)


def _conflicts(knowledge: Knowledge, known: Evidence) -> Iterator[tuple[str, ...]]:
    """Yield the conflicts that only what is in the FMEA can be behind."""
    for conflict in known.conflicts:
        if UNKNOWN not in conflict:
            yield tuple(sorted(conflict, key=knowledge.model.mode_place))


def _fewest(sets: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Leave out what holds whenever another one does: the sets that have a smaller one inside."""
    kept: list[tuple[str, ...]] = []
    for names in sorted(sets, key=lambda names: (len(names), names)):
        if not any(frozenset(other) <= frozenset(names) for other in kept):
            kept.append(names)
    return kept


@dataclass(frozen=True, slots=True)
class _Found:
    """Cut sets with their shares, the most probable first."""

    sets: tuple[tuple[frozenset[str], float], ...] = ()
    covered: float = 0.0
    incomplete: str = ""


def _best(knowledge: Knowledge, known: Evidence, tree: FaultTree, effort: Effort) -> _Found:
    """Return the cut sets that are most probable given the evidence.

    They are looked at in order of the most that each can come to, so that nothing that follows
    can be better than what the next one could be.
    """
    analysis = analyse(tree, budget=Budget(_NODES, effort.budget.deadline))
    if analysis.cut_sets is None:
        return _Found(incomplete=analysis.incomplete)
    priors = {name: tree.events[name].probability or 0.0 for name in analysis.events}
    at_most = _weighed(knowledge.model, known, priors)
    best: list[tuple[float, int, frozenset[str]]] = []
    looked_at, spent, total = 0, 0.0, 0.0
    for faults in ranked(analysis, at_most):
        bound = _product(at_most, faults)
        full = len(best) == effort.hypotheses
        if looked_at == _MOST_LOOKED_AT or (full and best[0][0] >= bound):
            break
        looked_at, spent = looked_at + 1, spent + bound
        weight = _product(priors, faults) * likelihood(knowledge.model, known, faults)
        total += weight
        heapq.heappush(best, (weight, -looked_at, faults))
        if full:
            heapq.heappop(best)
    rest = max(0.0, analysis.cut_sets.rare_event_sum(at_most) - spent)
    return _shares(sorted(best, reverse=True), total, rest, analysis, effort)


def _weighed(model: Model, known: Evidence, priors: Mapping[str, float]) -> dict[str, float]:
    """Return the priors, less where a symptom that the failure mode shows is surely absent."""
    weighed = dict(priors)
    for link in model.links:
        seen = known.observations.get(link.symptom)
        if link.cause in weighed and seen == Observation("absent"):
            weighed[link.cause] *= 1.0 - link.detects
    return weighed


def _shares(
    best: list[tuple[float, int, frozenset[str]]], total: float, rest: float,
    analysis: Analysis, effort: Effort,
) -> _Found:  # fmt: skip
    sets = tuple((faults, weight / total) for weight, _, faults in best if weight > 0.0)
    covered = sum(weight for weight, _, _ in best) / (total + rest) if sets else 0.0
    every = analysis.minimal_cut_sets or 0
    is_cut = covered < effort.mass and len(best) < every
    cut = f"the {len(best)} most probable of {every:,} minimal cut sets" if is_cut else ""
    return _Found(sets, covered, cut)


def _product(chances: Mapping[str, float], faults: Iterable[str]) -> float:
    product = 1.0
    for name in faults:
        product *= chances[name]
    return product


def likelihood(model: Model, known: Evidence, faults: frozenset[str]) -> float:
    """Return how probable what is known is while exactly these failure modes are there.

    What absent symptoms would do without any fault is left out: it is the same for all.
    """
    prediction = predict(model, faults)
    chance = 1.0
    for name, seen in known.observations.items():
        place = model.sign_places.get(name)
        if place is None or seen.state == "unknown":
            continue
        if seen.state == "present" or place in prediction.misses:
            chance *= _of_observation(model, place, seen, prediction)
    for given in known.answers:
        level = given.check.level(given.outcome)
        chance *= outcomes(model, given.check, prediction)[level]
    return chance


def _of_observation(model: Model, place: int, seen: Observation, prediction: Prediction) -> float:
    present, tossed = prediction.present(model, place), (1.0 - seen.strength) / 2.0
    if seen.state == "present":
        return seen.strength * present + tossed
    without = seen.strength * (1.0 - model.signs[place].leak) + tossed
    return (seen.strength * (1.0 - present) + tossed) / without if without else 1.0


def _hypotheses(
    knowledge: Knowledge, known: Evidence, causes: Mapping[str, tuple[str, ...]], found: _Found
) -> tuple[tuple[Hypothesis, ...], tuple[AmbiguityGroup, ...]]:
    model, seen = knowledge.model, Known.of(knowledge.model, known)
    places = seen.absent.union(place for _, place in seen.present)
    hypotheses, signatures = [], []
    for faults, share in found.sets:
        prediction = predict(model, faults)
        hypothesis = seen.hypothesis(model, faults, share, prediction)
        hypotheses.append(replace(hypothesis, proof=proof(knowledge, causes, faults)))
        signatures.append(signature(model, known, places, prediction))
    return grouped(hypotheses, signatures)


def proof(
    knowledge: Knowledge, causes: Mapping[str, tuple[str, ...]], faults: frozenset[str]
) -> str:
    """Say for each symptom on which way through the tree the faults lead to it."""
    gone = lost(knowledge.fmea, faults)
    lines = []
    for symptom, of in causes.items():
        ways = [chain(knowledge.fmea, cause, faults, gone) for cause in of
                if cause in faults or cause in gone]  # fmt: skip
        lines.append(f"{symptom}: {'; or '.join(ways)}")
    return "\n".join(lines)


def _split(
    knowledge: Knowledge, known: Evidence, hypotheses: tuple[Hypothesis, ...],
    group: AmbiguityGroup,
) -> AmbiguityGroup:  # fmt: skip
    if len(group.members) < 2:
        return group
    checks = tuple(knowledge.checks.values())
    best = splitting_test(knowledge.model, known, hypotheses, group.members, checks)
    return replace(group, split_by="" if best is None else best.test.id)
