"""From a diagnosis to its explanation: a pure function of what is given."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

from amberbox.core.types import Diagnosis, Hypothesis, Symptom
from amberbox.diagnosis.explanation.activity import Activity
from amberbox.diagnosis.explanation.alike import alike
from amberbox.diagnosis.explanation.details import details_of
from amberbox.diagnosis.explanation.explanation import Explanation, Fault, Seen
from amberbox.diagnosis.explanation.graph import graph_of
from amberbox.diagnosis.explanation.grouping import described, groups_of
from amberbox.diagnosis.explanation.headline import headline
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.explanation.seen import Sights
from amberbox.diagnosis.explanation.step import Leading, step_of
from amberbox.diagnosis.explanation.sureness import sureness
from amberbox.diagnosis.explanation.use import use_of
from amberbox.diagnosis.knowledge import Knowledge

OTHERS = 3
"""How many groups are told besides the leading one."""


def explain(diagnosis: Diagnosis, knowledge: Knowledge, symptoms: Iterable[Symptom]) -> Explanation:
    """Tell a diagnosis in words.

    ``symptoms`` are those it was made of, with their times and what they were measured from;
    what is not among them is told without. Failure modes and tests that the knowledge does not
    have are called by their ids.
    """
    symptoms = tuple(symptoms)
    activity = Activity.of(knowledge, diagnosis, symptoms)
    names = Names(knowledge.fmea, activity.cleared)
    sights = Sights.of(names, diagnosis, symptoms, activity.weights)
    found = _alike(activity, groups_of(diagnosis))
    members = found[0][1] if found else ()
    active = [(group, tuple(map(activity.active, of))) for group, of in found]
    groups = [described(names, *group) for group in found[: 1 + OTHERS]]
    broken, others = (groups[0] if groups else None), groups[1:]
    others_with = list(zip(others, (group[1] for group in active[1:]), strict=False))
    sure = sureness(diagnosis, broken, alike(names, diagnosis, members))
    use = use_of(sights.ways, active[0][1] if active else (), others_with)
    explained, missed = _explained(members), _missed(diagnosis, members)
    return Explanation(
        diagnosis.id,
        diagnosis.revision,
        diagnosis.robot,
        diagnosis.at_ns,
        diagnosis.state,
        headline(diagnosis, broken, sure, symptoms),
        broken,
        sure,
        sights.worst_first(explained, members),
        sights.worst_first(missed, ()),
        sights.in_time((name for h in members for name in h.contradicted), members),
        diagnosis.findings,
        _blocked(sights, symptoms, {*explained, *missed}),
        tuple(others),
        use,
        step_of(knowledge, names, diagnosis, active[0] if active else None),
        details_of(diagnosis, found),
        graph_of(sights, found[: 1 + OTHERS]),
        cleared=_cleared(names, members),
    )


def _alike(activity: Activity, found: Iterable[Leading]) -> list[Leading]:
    """Join groups that differ by causes alone that show no more, the most probable first."""
    joined: dict[frozenset[frozenset[str]], Leading] = {}
    for group, members in found:
        key = frozenset(activity.active(hypothesis).faults for hypothesis in members)
        first, of = joined.get(key, (replace(group, probability=0.0), members))
        whole = min(1.0, first.probability + group.probability)
        joined[key] = replace(first, probability=whole), of
    return sorted(joined.values(), key=lambda one: -one[0].probability)


def _cleared(names: Names, members: Sequence[Hypothesis]) -> tuple[Fault, ...]:
    """Return what shows no more of what leads, beside what does."""
    lasting = [h for h in members if h.faults - names.cleared.keys()]
    faults = dict.fromkeys(fault for h in lasting for fault in in_order(h.faults))
    return tuple(names.fault(fault) for fault in faults if fault in names.cleared)


def _explained(members: Sequence[Hypothesis]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for h in members for name in h.explains))


def _missed(diagnosis: Diagnosis, members: Sequence[Hypothesis]) -> tuple[str, ...]:
    """Return what was seen and does not follow from what leads."""
    explained = _explained(members)
    missed = [name for h in members for name in h.unexplained]
    if not members:
        missed = [name for name in diagnosis.symptoms if name not in diagnosis.findings]
    return tuple(dict.fromkeys(name for name in missed if name not in explained))


def _blocked(
    sights: Sights, symptoms: Sequence[Symptom], counted: Collection[str]
) -> tuple[Seen, ...]:
    """Return what shows and does not count, as something that it depends on is not well."""
    blocked = (s.id for s in symptoms if s.state == "present" and s.blocked_by)
    return sights.in_time((name for name in blocked if name not in counted), ())
