"""From the analysis to fault trees: what must fail so that a function is lost.

A component does not serve when one of its failure modes takes it down or its needs are not met,
a function when its needs are not met. So every loss is a gate and every failure mode an event;
what several functions need is one gate that all of them use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from amberbox.core.naming import component_named
from amberbox.core.needs import Needs
from amberbox.diagnosis.faulttree.formula import (
    Constant,
    Formula,
    Name,
    all_of,
    any_of,
    at_least,
    names,
)
from amberbox.diagnosis.faulttree.tree import BasicEvent, FaultTree, Gate
from amberbox.diagnosis.fmea.model import Fmea

NEVER = Constant(False)


def effects(fmea: Fmea) -> tuple[str, ...]:
    """Return the effects on the system: the functions whose loss is one."""
    return fmea.system_functions()


def fault_tree_of(fmea: Fmea, effect: str, exposure_h: float | None = None) -> FaultTree:
    """Return the tree of the loss of a function, or of a component that no longer serves.

    An event's probability is that its failure mode is there, after an exposure or after its own.
    The beta of a mode is left out: whether its effect comes about is what the tree computes.
    Raises UsageError for an effect that there is not.
    """
    needs = fmea.needs()
    known = ", ".join(effects(fmea)) or "none; components can be named, too"
    hint = f"effects on the system: {known}"
    effect = component_named(effect, needs, kind="effect", hint=hint)
    return tree_over(fmea, effect, {}, exposure_h)


def tree_over(
    fmea: Fmea, top: str, gates: Mapping[str, Gate], exposure_h: float | None = None
) -> FaultTree:
    """Return the tree below ``top``: gates of one's own over failure modes and losses.

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
    """Return when needs are not met: more parts are lost than can be spared."""
    if needs.at_least <= 0:
        return NEVER
    parts = [Name(part) if isinstance(part, str) else unmet(part) for part in needs.parts]
    enough = len(parts) - needs.at_least + 1
    if len(parts) == 1:
        return parts[0]
    if enough == 1:
        return any_of(*parts)
    return all_of(*parts) if enough == len(parts) else at_least(enough, *parts)
