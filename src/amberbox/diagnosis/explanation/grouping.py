"""The groups of a diagnosis in words: what is common to all members is said once."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis
from amberbox.diagnosis.explanation.explanation import Group
from amberbox.diagnosis.explanation.instances import as_one, kinds_of
from amberbox.diagnosis.explanation.names import Names, in_order
from amberbox.diagnosis.explanation.words import both, either


def groups_of(diagnosis: Diagnosis) -> tuple[tuple[AmbiguityGroup, tuple[Hypothesis, ...]], ...]:
    """Return the groups with their members; hypotheses of no group are groups by themselves."""
    by_id = {hypothesis.id: hypothesis for hypothesis in diagnosis.hypotheses}
    grouped = {name for g in diagnosis.groups for name in (*g.members, *g.wider)}
    alone = (
        AmbiguityGroup((hypothesis.id,), hypothesis.probability)
        for hypothesis in diagnosis.hypotheses
        if hypothesis.id not in grouped
    )
    groups = sorted((*diagnosis.groups, *alone), key=lambda group: -group.probability)
    found = ((g, tuple(by_id[name] for name in g.members if name in by_id)) for g in groups)
    return tuple((group, members) for group, members in found if members)


def described(names: Names, group: AmbiguityGroup, members: Sequence[Hypothesis]) -> Group:
    """Describe a group."""
    possibilities = tuple(names.possibility(hypothesis) for hypothesis in members)
    return Group(_text(names, members), group.probability, possibilities, group.wider)


def _text(names: Names, members: Sequence[Hypothesis]) -> str:
    sets = list(dict.fromkeys(frozenset(names.active(hypothesis.faults)) for hypothesis in members))
    if len(sets) == 1:
        return names.faults(sets[0])
    common = frozenset.intersection(*sets)
    rests = [faults - common for faults in sets]
    if not common or not all(rests):
        texts = _texts(names, sets)
        return texts[0] if len(texts) == 1 else f"one of: {either(texts)}"
    rest = either(_texts(names, rests))
    return (
        f"{both([names.mode(fault) for fault in in_order(common)])}, together with one of: {rest}"
    )


def _texts(names: Names, sets: Sequence[Collection[str]]) -> list[str]:
    """Describe sets of failure modes; those that differ by an instance alone are one."""
    kinds = [kinds_of(names.fmea, faults) for faults in sets]
    return as_one(kinds, [names.faults(faults) for faults in sets])
