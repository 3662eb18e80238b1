"""Diagnosis by fault trees: the minimal cut sets of what is seen, ranked by the evidence."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from amberbox.core.contracts import Budget, EvidenceWindow
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.diagnosis.covering.hypotheses import (
    KnownSymptoms,
    RankedHypotheses,
    group_hypotheses,
    signature,
)
from amberbox.diagnosis.covering.model import UNKNOWN, Model
from amberbox.diagnosis.covering.observations import (
    Evidence,
    Observation,
    Prediction,
    outcomes,
    predict,
)
from amberbox.diagnosis.diagnose import (
    DiagnosisContext,
    DiagnosisId,
    Effort,
    ObservedSituation,
    build_diagnosis,
    diagnosis_id_of,
    evidence_of_situation,
)
from amberbox.diagnosis.faulttree.analysis import Analysis, analyse, ranked
from amberbox.diagnosis.faulttree.probable import union_bounds
from amberbox.diagnosis.faulttree.tree import BooleanConstant, FaultTree, Gate, all_of, any_of
from amberbox.diagnosis.fmea.fault_trees import tree_over
from amberbox.diagnosis.fmea.model import Fmea, lost
from amberbox.diagnosis.knowledge import Knowledge


def causal_chain(fmea: Fmea, cause: str, faults: Collection[str], gone: Collection[str]) -> str:
    """Return the chain to a cause: ``carry lost because see lost because laser_front#dead``.

    ``gone`` is what these faults take out of service (``propagation.lost``). A failure mode is a
    reason by itself.
    """
    if cause in fmea.modes:
        return cause
    component = fmea.components.get(cause)
    modes = component.modes if component else ()
    own = [mode for mode in modes if mode in faults and fmea.modes[mode].takes_down]
    if own:
        return own[0]
    needed = [name for name in fmea.needs()[cause].names() if name in gone]
    reasons = [causal_chain(fmea, name, faults, gone) for name in needed]
    return f"{cause} lost because {_joined(reasons)}"


def _joined(reasons: list[str]) -> str:
    """Join reasons; those that have reasons of their own are in brackets."""
    distinct = list(dict.fromkeys(reasons))
    if len(distinct) == 1:
        return distinct[0]
    return " and ".join(f"({text})" if " " in text else text for text in distinct)


TOP = "all that is seen"
_NODES = 300_000
_BELIEVED = 0.5
_MOST_LOOKED_AT = 2_000


ALONE = "By the fault trees alone, which know of no false alarm:"
NOTHING = ""
NO_ANSWERS = ""


def alone(knowledge: Knowledge, window: EvidenceWindow, case: DiagnosisContext) -> Diagnosis | None:
    """Return the diagnosis of a case by fault trees; None without a symptom."""
    if not case.situation.present():
        return None
    made = conclude(knowledge, case.situation, diagnosis_id_of(knowledge, case))
    return made if made.hypotheses or made.symptoms else None


def conclude(
    knowledge: Knowledge,
    situation: ObservedSituation,
    heading: DiagnosisId,
    effort: Effort | None = None,
) -> Diagnosis:
    """Return the diagnosis of a situation by fault trees: a pure function of its arguments.

    Probabilities are shares among the cut sets that were enumerated; ``mass_covered`` is a lower
    bound of the share of the listed ones in all cut sets. ``incomplete`` names what was cut off.
    The proof of a hypothesis is the path through the tree, a line per symptom. Raises UsageError
    for answers and conflicts with names that the knowledge does not have.
    """
    effort = effort or Effort()
    known = evidence_of_situation(knowledge, situation)
    causes = _causes(knowledge, known)
    explains = causes or known.conflicts or not any(map(_believed, known.observations.values()))
    found = _Found()  # symptoms unknown to the FMEA have no tree
    if explains:
        found = _best(knowledge, known, _tree(knowledge, known, causes), effort)
    hypotheses, groups = _hypotheses(knowledge, known, causes, found)
    unknown = tuple(name for name in known.observations if name not in knowledge.model.sign_places)
    ranked_sets = RankedHypotheses(hypotheses, groups, found.covered, found.incomplete, unknown)
    return build_diagnosis(knowledge, situation, heading, known, ranked_sets, effort)


def _causes(knowledge: Knowledge, known: Evidence) -> dict[str, tuple[str, ...]]:
    """Return by present symptom the failure modes and losses that show it.

    If all of them are unknown to the FMEA, the component that shows them counts as lost.
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
    """Return whether a symptom must have a cause; weaker ones only count in the ranking."""
    return seen.state == "present" and seen.strength >= _BELIEVED


def _tree(
    knowledge: Knowledge, known: Evidence, causes: Mapping[str, tuple[str, ...]]
) -> FaultTree:
    """Return the tree whose top event is that all present symptoms occur together."""
    fewest = _fewest({*causes.values(), *_conflicts(knowledge, known)})
    gates = {
        f"seen {place}": Gate(f"seen {place}", any_of(*names)) for place, names in enumerate(fewest)
    }
    gates[TOP] = Gate(TOP, all_of(*gates) if gates else BooleanConstant(True))
    return tree_over(knowledge.fmea, TOP, gates, knowledge.exposure_h)


def _conflicts(knowledge: Knowledge, known: Evidence) -> Iterator[tuple[str, ...]]:
    """Yield the conflicts that consist only of failure modes of the FMEA."""
    for conflict in known.conflicts:
        if UNKNOWN not in conflict:
            yield tuple(sorted(conflict, key=knowledge.model.mode_place))


def _fewest(sets: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the minimal sets: those that contain no other one."""
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

    They are evaluated in order of their upper bounds, so that the search can end once no further
    set can be better.
    """
    asked = effort.budget
    analysis = analyse(tree, budget=Budget(_NODES, asked.is_over, is_past=asked.is_past))
    if analysis.cut_sets is None and analysis.probable is None:
        return _Found(incomplete=analysis.incomplete)
    priors = {name: tree.events[name].probability or 0.0 for name in analysis.events}
    at_most = dict(priors)  # less where a symptom that the failure mode shows is surely absent
    for link in knowledge.model.links:
        seen = known.observations.get(link.symptom)
        if link.cause in at_most and seen == Observation("absent"):
            at_most[link.cause] *= 1.0 - link.detects
    best: list[tuple[float, int, frozenset[str]]] = []
    looked_at, spent, total = 0, 0.0, 0.0
    candidates = ranked(analysis, at_most) if analysis.cut_sets is not None else _probable(analysis)
    for faults in candidates:
        bound = _product(at_most, faults)
        full = len(best) == effort.hypotheses
        ends = full and best[0][0] >= bound and analysis.cut_sets is not None
        if looked_at == _MOST_LOOKED_AT or ends:
            break
        looked_at, spent = looked_at + 1, spent + bound
        weight = _product(priors, faults) * likelihood(knowledge.model, known, faults)
        total += weight
        heapq.heappush(best, (weight, -looked_at, faults))
        if full:
            heapq.heappop(best)
    if analysis.cut_sets is None:
        return _shares_of_probable(sorted(best, reverse=True), total, priors, analysis)
    rest = max(0.0, analysis.cut_sets.rare_event_sum(at_most) - spent)
    return _shares(sorted(best, reverse=True), total, rest, analysis, effort)


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


def _probable(analysis: Analysis) -> tuple[frozenset[str], ...]:
    return analysis.probable.sets if analysis.probable is not None else ()


def _shares_of_probable(
    best: list[tuple[float, int, frozenset[str]]], total: float, priors: Mapping[str, float],
    analysis: Analysis,
) -> _Found:  # fmt: skip
    """Return shares where not all cut sets are known: the rest is what the bounds leave open."""
    sets = tuple((faults, weight / total) for weight, _, faults in best if weight > 0.0)
    covered = 0.0
    if sets and analysis.bounds is not None and analysis.probable is not None:
        by_sets, _ = union_bounds(analysis.probable, priors)
        rest = max(0.0, analysis.bounds.upper - by_sets)
        covered = sum(weight for weight, _, _ in best) / (total + rest)
    return _Found(sets, covered, analysis.incomplete)


def _product(chances: Mapping[str, float], faults: Iterable[str]) -> float:
    product = 1.0
    for name in faults:
        product *= chances[name]
    return product


def likelihood(model: Model, known: Evidence, faults: frozenset[str]) -> float:
    """Return the likelihood of the evidence, given exactly these failure modes.

    The factor of absent symptoms without any fault is left out: it is the same for all.
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
    model, seen = knowledge.model, KnownSymptoms.of(knowledge.model, known)
    places = seen.absent.union(place for _, place in seen.present)
    hypotheses, signatures = [], []
    for faults, share in found.sets:
        prediction = predict(model, faults)
        hypothesis = seen.hypothesis(model, faults, share, prediction)
        hypotheses.append(replace(hypothesis, proof=proof(knowledge, causes, faults)))
        signatures.append(signature(model, known, places, prediction))
    return group_hypotheses(hypotheses, signatures)


def proof(
    knowledge: Knowledge, causes: Mapping[str, tuple[str, ...]], faults: frozenset[str]
) -> str:
    """Return for each symptom the path through the tree from the faults to it."""
    gone = lost(knowledge.fmea, faults)
    lines = []
    for symptom, of in causes.items():
        ways = [causal_chain(knowledge.fmea, cause, faults, gone) for cause in of
                if cause in faults or cause in gone]  # fmt: skip
        lines.append(f"{symptom}: {'; or '.join(ways)}")
    return "\n".join(lines)
