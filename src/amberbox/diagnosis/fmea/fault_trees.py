"""Fault trees of an FMEA, one for the loss of each function; solved trees as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from amberbox.core.names import component_id
from amberbox.core.needs import Needs
from amberbox.core.types import Diagnosis
from amberbox.diagnosis.faulttree.analysis import Analysis, NearCutSet, most_probable, nearest
from amberbox.diagnosis.faulttree.tree import (
    BasicEvent,
    BooleanConstant,
    FaultTree,
    Formula,
    Gate,
    Name,
    all_of,
    any_of,
    at_least,
    names,
)
from amberbox.diagnosis.fmea.model import Fmea

NEVER = BooleanConstant(False)


def effects(fmea: Fmea) -> tuple[str, ...]:
    """Return the effects on the system: the functions whose loss is one."""
    return fmea.system_functions()


def fault_tree_of(fmea: Fmea, effect: str, exposure_h: float | None = None) -> FaultTree:
    """Return the tree of the loss of a function, or of a component that no longer serves.

    An event's probability is that its failure mode is present, after an exposure or after its own.
    The beta of a mode is left out, because the tree computes whether its effect occurs. Raises
    UsageError for an unknown effect.
    """
    needs = fmea.needs()
    known = ", ".join(effects(fmea)) or "none; components can be named, too"
    hint = f"effects on the system: {known}"
    effect = component_id(effect, needs, kind="effect", hint=hint)
    return tree_over(fmea, effect, {}, exposure_h)


def tree_over(
    fmea: Fmea, top: str, gates: Mapping[str, Gate], exposure_h: float | None = None
) -> FaultTree:
    """Return the tree below ``top``: given gates over failure modes and losses.

    ``gates`` may name failure modes, and components and functions: these stand for their loss.
    """
    needs = fmea.needs()
    found: dict[str, Gate] = {}
    events: dict[str, BasicEvent] = {}
    waiting = [top]
    while waiting:
        name = waiting.pop()
        if name in fmea.modes:
            mode = fmea.modes[name]
            events[name] = BasicEvent(name, mode.chance(exposure_h), mode.description)
        elif name not in found and (name in gates or name in needs):
            found[name] = gates[name] if name in gates else _loss(fmea, name, needs[name])
            waiting += reversed(names(found[name].formula))
    return FaultTree(fmea.name, top, found, events)


def _loss(fmea: Fmea, name: str, needs: Needs) -> Gate:
    """Return the gate of something that no longer serves."""
    causes: list[Formula] = [Name(mode) for mode in _own(fmea, name)]
    causes += [unmet(needs)] if needs.parts else []
    formula = any_of(*causes) if len(causes) > 1 else next(iter(causes), NEVER)
    return Gate(name, formula, _label(fmea, name))


def _own(fmea: Fmea, name: str) -> Iterator[str]:
    component = fmea.components.get(name)
    for mode in component.modes if component else ():
        if fmea.modes[mode].takes_down:
            yield mode


def _label(fmea: Fmea, name: str) -> str:
    if name in fmea.functions:
        return _labelled("lost", fmea.functions[name].description)
    return _labelled("does not serve", fmea.components[name].description)


def _labelled(what: str, description: str) -> str:
    return f"{what}: {description}" if description else ""


def unmet(needs: Needs) -> Formula:
    """Return the formula of unmet needs: more parts are lost than can be spared."""
    if needs.at_least <= 0:
        return NEVER
    parts = [Name(part) if isinstance(part, str) else unmet(part) for part in needs.parts]
    enough = len(parts) - needs.at_least + 1
    if len(parts) == 1:
        return parts[0]
    if enough == 1:
        return any_of(*parts)
    return all_of(*parts) if enough == len(parts) else at_least(enough, *parts)


FACTORS = ("mif", "cif", "dif", "raw", "rrw")  # measures of how much an event matters


def analysis_json(
    analysis: Analysis, importance: bool = False, cut_sets: int = 0, probable: int = 0
) -> dict[str, Any]:
    """Return all numbers; importance, the smallest and the most probable cut sets if requested.

    The most probable ones are also there where not all cut sets could be found.
    """
    by_order, bounds = analysis.by_order, analysis.bounds
    answer: dict[str, Any] = {
        "top": analysis.tree.top,
        "gates": len(analysis.gates),
        "basic_events": len(analysis.events),
        "coherent": analysis.coherent,
        "minimal_cut_sets": analysis.minimal_cut_sets,
        "by_order": None if by_order is None else list(by_order),
        "truncated_at": analysis.truncated_at,
        "top_probability": analysis.top_probability,
        "probability_bounds": None if bounds is None else [bounds.lower, bounds.upper],
        "rare_event_sum": analysis.rare_event_sum(),
        "min_cut_upper_bound": analysis.upper_bound(),
        "without_probability": list(analysis.without_probability),
        "importance": None,
        "incomplete": bool(analysis.incomplete),
        "incomplete_because": analysis.incomplete,
    }
    if importance and analysis.top_probability is not None:
        answer["importance"] = {
            event: {name: _finite(getattr(entry, name)) for name in FACTORS}
            for event, entry in analysis.importance.items()
        }
    if cut_sets:
        answer["cut_sets"] = [sorted(entry) for entry in smallest_cut_sets(analysis, cut_sets)]
    if probable or analysis.probable is not None:
        answer["most_probable"] = most_probable_json(analysis, probable or LISTED)
    return answer


LISTED = 10  # most probable cut sets that are shown when not all could be found


def most_probable_json(analysis: Analysis, count: int) -> dict[str, Any] | None:
    """Return the most probable cut sets and their share; None if none could be looked for."""
    found = most_probable(analysis, count)
    if found is None:
        return None
    chances = found.probabilities or (None,) * len(found.sets)
    return {
        "cut_sets": [
            {"events": sorted(events), "probability": chance}
            for events, chance in zip(found.sets, chances, strict=True)
        ],
        "certain": found.certain,
        "share": None if found.share is None else list(found.share),
    }


def smallest_cut_sets(analysis: Analysis, count: int) -> list[frozenset[str]]:
    """Return the smallest cut sets."""
    return list(islice(analysis.cut_sets or (), count))


def effects_json(
    fmea: Fmea,
    found: Sequence[Analysis],
    exposure_h: float | None = None,
    importance: bool = False,
    cut_sets: int = 0,
    probable: int = 0,
) -> dict[str, Any]:
    """Return the trees of several effects."""
    return {
        "exposure_h": fmea.exposure_h if exposure_h is None else exposure_h,
        "effects": [effect_json(fmea, one, importance, cut_sets, probable) for one in found],
        "incomplete": any(analysis.incomplete for analysis in found),
    }


def effect_json(
    fmea: Fmea,
    analysis: Analysis,
    importance: bool = False,
    cut_sets: int = 0,
    probable: int = 0,
) -> dict[str, Any]:
    """Return the tree of one effect, and what its loss means."""
    shown = analysis_json(analysis, importance, cut_sets, probable)
    return {"effect": analysis.tree.top, **description(fmea, analysis), **shown}


def description(fmea: Fmea, analysis: Analysis) -> dict[str, str]:
    """Return the description of a tree's top event and the severity of its loss.

    Of a tree that is not made of failure modes, the label of its top gate.
    """
    tree = analysis.tree
    function, component = fmea.functions.get(tree.top), fmea.components.get(tree.top)
    if function is not None:
        return {"description": function.description, "severity": function.severity}
    label = tree.gates[tree.top].label
    return {"description": component.description if component is not None else label}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


@dataclass(frozen=True, slots=True)
class EffectOutlook:
    """An effect on the system and the cut sets that are closest to bringing it about."""

    analysis: Analysis
    near: list[NearCutSet]

    @property
    def rank(self) -> tuple[bool, float]:
        """Return a sort key: effects with an event that has happened come first."""
        has_begun = any(near.happened for near in self.near)
        return not has_begun, -self.near[0].probability if self.near else 0.0


def outlooks(
    solved: Iterable[Analysis], diagnosis: Diagnosis | None, count: int
) -> list[EffectOutlook]:
    """Return the closest cut sets of each effect, the effect that is closest first."""
    found = [EffectOutlook(analysis, nearest(analysis, diagnosis, count)) for analysis in solved]
    return sorted(found, key=lambda outlook: outlook.rank)


def closest_json(
    fmea: Fmea, at_ns: int | None, diagnosis: Diagnosis | None, found: Iterable[EffectOutlook]
) -> dict[str, Any]:
    """Return outlooks as JSON-compatible values."""
    return {
        "at_ns": at_ns,
        "diagnosis": diagnosis.id if diagnosis else None,
        "effects": [
            {
                "effect": outlook.analysis.tree.top,
                **description(fmea, outlook.analysis),
                "truncated_at": outlook.analysis.truncated_at,
                "closest": [
                    {
                        "probability": near.probability,
                        "happened": list(near.happened),
                        "missing": list(near.missing),
                        "events": dict(near.events),
                    }
                    for near in outlook.near
                ],
            }
            for outlook in found
        ],
    }
