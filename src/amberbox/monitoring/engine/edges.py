"""The dependencies between components: in which order they are looked at, and what blocks whom."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from amberbox.core.needs import Needs
from amberbox.monitoring.engine.modestate import ModeState
from amberbox.monitoring.engine.outputs import FUNCTIONAL, OutputState
from amberbox.monitoring.plan import ComponentPlan, DependencyPlan, Plan

_LONGEST = 4


class Blocker(NamedTuple):
    """A dependency that is not ok. ``label`` is a component or ``component/mode``.

    ``link`` says why, along the chain of what it waits for itself; ``end`` is where that ends,
    ``steps`` away. It is ``faulty`` if what is wrong is known, not only unknown.
    """

    label: str
    link: str
    end: str
    steps: int
    faulty: bool


def blocker(label: str, words: str, reason: str, faulty: bool, waits: Sequence[Blocker]) -> Blocker:
    """Make a blocker of a component that may be waiting for others itself."""
    if not waits:
        text = f"{label}: {reason}" if reason else f"{label} ({words})"
        return Blocker(label, text, text, 0, faulty)
    first, steps = waits[0], waits[0].steps + 1
    faulty = faulty or any(wait.faulty for wait in waits)
    if steps > _LONGEST:
        text = f"{label} ({words}), which in the end waits for {first.end}"
    else:
        more = f" and {len(waits) - 1} more" if len(waits) > 1 else ""
        text = f"{label} ({words}), which waits for {first.link}{more}"
    return Blocker(label, text, first.end, steps, faulty)


@dataclass(frozen=True, slots=True)
class JudgedByMode:
    """An edge that a mode of the dependency judges, or one output of it."""

    label: str
    mode: ModeState
    output: OutputState | None

    def blocking(self) -> tuple[Blocker, ...]:
        """Return what it blocks with: nothing if it is ok."""
        level = self.mode.level if self.output is None else self.output.level
        if level in FUNCTIONAL:
            return ()
        return (blocker(self.label, level, self.mode.reason, level in ("error", "stale"), ()),)


Passed: TypeAlias = Callable[[int], Sequence[Blocker]]
"""Answers what the component at a place blocks others with."""


@dataclass(slots=True)
class Judges:
    """What speaks for dependencies all of which are needed: components (by place), and modes."""

    components: list[int] = field(default_factory=list)
    modes: list[JudgedByMode] = field(default_factory=list)

    def blocking(self, passed: Passed) -> list[Blocker]:
        """Return all that is not ok."""
        found = [b for place in dict.fromkeys(self.components) for b in passed(place)]
        return found + [b for judge in dict.fromkeys(self.modes) for b in judge.blocking()]


@dataclass(frozen=True, slots=True)
class Gate:
    """Some dependencies of which at least so many are needed."""

    at_least: int
    parts: tuple[Gate | Judges, ...]

    def blocking(self, passed: Passed) -> list[Blocker]:
        """Return what is not ok of all parts if too few of them are ok."""
        found = [part.blocking(passed) for part in self.parts]
        if sum(not blockers for blockers in found) >= self.at_least:
            return []
        return [b for blockers in found for b in blockers]


@dataclass(frozen=True, slots=True)
class Edges:
    """What a component depends on: ``sources`` are the components (places) that matter for it.

    Of ``components`` among them it matters what blocks them. ``notes`` name the dependencies that
    nothing judges: they never block.
    """

    needs: Gate | Judges
    components: frozenset[int]
    sources: frozenset[int]
    notes: tuple[str, ...]


def edges_of(
    component: ComponentPlan,
    places: Mapping[str, int],
    modes: Mapping[tuple[str, str], ModeState],
    allowed: frozenset[int],
) -> Edges:
    """Find what a component depends on, among the components that it may depend on."""
    by_name: dict[str, Judges] = {}
    components, sources, open_names = set(), set(), []
    whole = Judges()
    for dependency in component.dependencies:
        place = _place(dependency, places)
        mode = modes.get((dependency.component or "", dependency.mode))
        if place is None or (dependency.mode and mode is None):
            open_names.append(dependency.name)
        elif place in allowed:
            own = whole if component.needs is None else Judges()
            judges = by_name.setdefault(dependency.name, own)
            sources.add(place)
            if mode is None:
                components.add(place)
                judges.components.append(place)
            else:
                judges.modes.append(_judge(dependency, mode))
    names = dict.fromkeys(name for name in open_names if name not in by_name)
    notes = tuple(f"dependency {name} is not monitored" for name in names)
    needs = whole if component.needs is None else _gate(component.needs, by_name)
    return Edges(needs, frozenset(components), frozenset(sources), notes)


def _gate(needs: Needs, by_name: Mapping[str, Judges]) -> Gate:
    """Put judges in the place of names; what nothing judges is taken to be ok."""
    parts = (
        by_name.get(part, Judges()) if isinstance(part, str) else _gate(part, by_name)
        for part in needs.parts
    )
    return Gate(needs.at_least, tuple(parts))


def _place(dependency: DependencyPlan, places: Mapping[str, int]) -> int | None:
    if dependency.problem or not dependency.judged or dependency.component is None:
        return None
    return places.get(dependency.component)


def _judge(dependency: DependencyPlan, mode: ModeState) -> JudgedByMode:
    output = next((o for o in mode.outputs if o.plan.name == dependency.output), None)
    return JudgedByMode(f"{dependency.component}/{dependency.mode}", mode, output)


def in_order(plan: Plan) -> list[int]:
    """Return the places of all components, dependencies first, else as they are in the plan.

    Where there is a cycle, which the configuration refuses, its first component comes first.
    """
    places = {component.id: place for place, component in enumerate(plan.components)}
    needs = [_needs(component, places) - {p} for p, component in enumerate(plan.components)]
    users: list[list[int]] = [[] for _ in needs]
    for place, needed in enumerate(needs):
        for other in needed:
            users[other].append(place)
    missing = [len(needed) for needed in needs]
    ready = [place for place, count in enumerate(missing) if not count]
    order: list[int] = []
    left = dict.fromkeys(range(len(needs)))
    while left:
        place = heapq.heappop(ready) if ready else next(iter(left))
        if place not in left:
            continue
        del left[place]
        order.append(place)
        for user in users[place]:
            missing[user] -= 1
            if not missing[user] and user in left:
                heapq.heappush(ready, user)
    return order


def _needs(component: ComponentPlan, places: Mapping[str, int]) -> set[int]:
    found = (_place(dependency, places) for dependency in component.dependencies)
    return {place for place in found if place is not None}


def waiting_text(waits: Iterable[Blocker]) -> str:
    """Say what is waited for, along the chain."""
    return "waits for " + ", and for ".join(wait.link for wait in waits)
