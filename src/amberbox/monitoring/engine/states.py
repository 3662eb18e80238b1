"""From what is found of outputs to statuses, symptoms and alarms, instant by instant."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from amberbox.core.types import Output, Status
from amberbox.monitoring.engine.alarms import NEVER_NS, Action, Alarms
from amberbox.monitoring.engine.components import ComponentState
from amberbox.monitoring.engine.edges import edges_of, in_order
from amberbox.monitoring.engine.findings import (
    NS,
    AlarmChange,
    Finding,
    Found,
    Transition,
    View,
)
from amberbox.monitoring.engine.modestate import ModeState
from amberbox.monitoring.engine.outputs import OutputState
from amberbox.monitoring.engine.symptoms import Symptoms
from amberbox.monitoring.engine.wording import Words
from amberbox.monitoring.plan import OutputPlan, Plan

VERSION: Final = 1
_NOTHING: Final[Mapping[str, Output]] = MappingProxyType({})


class OutputPlace(NamedTuple):
    """Where an output stands; its number is its place in ``outputs_of``."""

    component: str
    mode: str
    output: OutputPlan


def outputs_of(plan: Plan) -> list[OutputPlace]:
    """Return all outputs of a plan in order."""
    return [
        OutputPlace(component.id, mode.id, output)
        for component, mode in plan.modes()
        for mapping in mode.mappings
        for output in mapping.outputs
    ]


class States:
    """The states of all components and modes: ``begin`` an epoch, then ``advance``.

    It looks at no clock and keeps no more than it needs to go on. How what is found is split
    into calls does not matter.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._words = Words(plan.robot, plan.config_hash)
        self._outputs: list[OutputState] = []
        self._modes: list[ModeState] = []
        self._components: list[ComponentState] = []
        self._build()
        self._symptoms = Symptoms(self._components)
        self._alarms = Alarms(plan.robot, plan.config_hash)
        self._timers: list[tuple[int, int]] = []
        self._named: set[int] = set()
        self._began_ns = self._done_ns = 0
        self._judge_all()

    def _build(self) -> None:
        plan = self.plan
        self._place_of_mode = [
            place for place, component in enumerate(plan.components) for _ in component.modes
        ]
        for number, (_, mode) in enumerate(plan.modes()):
            entries = [output for mapping in mode.mappings for output in mapping.outputs]
            states = [OutputState(entry, number) for entry in entries]
            self._outputs += states
            self._modes.append(ModeState(mode, number, states))
        known = {
            (self.plan.components[place].id, mode.plan.id): mode
            for place, mode in zip(self._place_of_mode, self._modes, strict=True)
        }
        self._connect(known)

    def _connect(self, known: Mapping[tuple[str, str], ModeState]) -> None:
        """Make the components, and note who looks at whom."""
        components = self.plan.components
        places = {component.id: place for place, component in enumerate(components)}
        self._order = in_order(self.plan)
        self._rank = {place: rank for rank, place in enumerate(self._order)}
        self._users: list[list[int]] = [[] for _ in components]
        self._watchers: list[list[int]] = [[] for _ in components]
        modes = iter(self._modes)
        for place, component in enumerate(components):
            own = [next(modes) for _ in component.modes]
            allowed = frozenset(self._order[: self._rank[place]])
            edges = edges_of(component, places, known, allowed)
            self._components.append(ComponentState(component, own, edges))
            for other in edges.components:
                self._users[other].append(self._rank[place])
            for other in edges.sources - edges.components:
                self._watchers[other].append(self._rank[place])

    def _judge_all(self) -> None:
        for place in self._order:
            self._components[place].judge(self._components)

    def begin(self, at_ns: int) -> list[Finding]:
        """Begin an epoch at an instant: nothing is measured, nothing is initialised.

        Alarms stay, but for those of components that are gone from the plan.
        """
        self._began_ns = self._done_ns = at_ns
        self._timers, self._named = [], set()
        for mode in self._modes:
            mode.begin(at_ns)
        for component in self._components:
            component.begin(at_ns)
        self._judge_all()
        known = {component.plan.id for component in self._components}
        findings: list[Finding] = list(self._alarms.drop(known, at_ns))
        for component in self._components:
            name = component.plan.id
            findings += self._alarms.update(name, at_ns, component.own, component.waits)
        transitions = (self._words.component_transition(c, at_ns) for c in self._components)
        findings += [transition for transition in transitions if transition is not None]
        findings += self._symptoms.begin(at_ns)
        self._tell_all(at_ns, None, findings)
        return findings

    def advance(self, found: Sequence[Found], until_ns: int, view: View) -> list[Finding]:
        """Return what follows from what was found, in order of time; ``until_ns`` is then done.

        ``found`` is sorted by time, after the last ``until_ns`` and not after this one.
        """
        findings: list[Finding] = []
        taken = 0
        second_ns = (self._done_ns // NS + 1) * NS
        while True:
            now_ns = min(second_ns, self._next_ns())
            if taken < len(found):
                now_ns = min(now_ns, found[taken].at_ns)
            if now_ns > until_ns:
                break
            first = taken
            while taken < len(found) and found[taken].at_ns <= now_ns:
                taken += 1
            full = now_ns == second_ns
            self._instant(now_ns, found[first:taken], view, full, findings)
            self._done_ns = now_ns
            second_ns += NS if full else 0
        self._done_ns = max(self._done_ns, until_ns)
        return findings

    def hold_up(self, from_ns: int, to_ns: int) -> None:
        """Put off what lasts until a time: while the recorder was held up nothing is known."""
        for number, output in enumerate(self._outputs):
            if output.hold_up(from_ns, to_ns):
                self._await(number, output)

    def _next_ns(self) -> int:
        """Return when something happens next by itself, no earlier than what is done."""
        next_ns = self._timers[0][0] if self._timers else NEVER_NS
        return max(min(next_ns, self._alarms.next_ns()), self._done_ns)

    def _instant(
        self, now_ns: int, found: Sequence[Found], view: View, full: bool, out: list[Finding]
    ) -> None:
        changes = _Changes()
        again, changes.alarms = self._alarms.due(now_ns)
        touched = self._take(now_ns, found, changes) if found or self._timers else set()
        if full and self._named:
            touched |= self._named
        if touched or again:
            self._judge_modes(sorted(touched), now_ns, view, changes)
            self._judge_components(now_ns, again, changes)
            out += self._transitions(now_ns, changes)
        out += changes.alarms
        out += self._symptoms.tell(changes.outputs, changes.blocked, now_ns)
        if full:
            self._tell_all(now_ns, view, out)
        elif changes.modes or changes.components:
            self._tell(now_ns, view, changes, out)

    def _take(self, now_ns: int, found: Sequence[Found], changes: _Changes) -> set[int]:
        """Take what was found and what is due; return the modes to look at."""
        touched: dict[int, OutputState] = {}
        for number, entry in {entry.output: entry for entry in found}.items():
            output = self._outputs[number]
            news = output.take(entry)
            if news != "none":
                touched[number] = output
            if news == "value":
                changes.modes.add(output.mode)
        while self._timers and self._timers[0][0] <= now_ns:
            due_ns, number = heapq.heappop(self._timers)
            output = self._outputs[number]
            if due_ns in (output.due_ns, output.calm_ns):
                touched[number] = output
        changes.outputs = touched.keys()
        for number, output in touched.items():
            output.settle(now_ns)
            self._await(number, output)
        return {output.mode for output in touched.values()}

    def _await(self, number: int, output: OutputState) -> None:
        for at_ns in (output.due_ns, output.calm_ns):
            if at_ns is not None:
                heapq.heappush(self._timers, (at_ns, number))

    def _judge_modes(
        self, numbers: Iterable[int], now_ns: int, view: View, changes: _Changes
    ) -> None:
        for number in numbers:
            mode = self._modes[number]
            before = mode.level, mode.state
            values = view.outputs(number, now_ns) if mode.plan.states else _NOTHING
            changes.looked_at.add(self._place_of_mode[number])
            if not mode.judge(values):
                continue
            changes.modes.add(number)
            changes.places.add(self._place_of_mode[number])
            if (mode.level, mode.state) != before:
                mode.since_ns = now_ns
            (self._named.add if mode.named else self._named.discard)(number)

    def _judge_components(self, now_ns: int, again: Iterable[str], changes: _Changes) -> None:
        """Look at components whose modes have changed and at those above them, in order."""
        ranks = {self._rank[place] for place in changes.places}
        ranks.update(rank for place in changes.looked_at for rank in self._watchers[place])
        alarming = set(again)
        queue = sorted(ranks)
        while queue:
            rank = heapq.heappop(queue)
            ranks.discard(rank)
            place = self._order[rank]
            for user in self._judge_component(place, now_ns, alarming, changes):
                if user not in ranks:
                    ranks.add(user)
                    heapq.heappush(queue, user)
        for component in self._components if alarming else ():
            if component.plan.id in alarming:
                changes.alarms += self._alarm(component, now_ns)

    def _judge_component(
        self, place: int, now_ns: int, alarming: set[str], changes: _Changes
    ) -> Sequence[int]:
        """Look at a component; return the ranks of those that are to be looked at for it."""
        component = self._components[place]
        own, waits, passed = component.own, component.waits, component.passed
        blocked_by, condition = component.blocked_by, (component.level, component.state)
        if place in changes.places:
            component.judge_modes()
        if component.judge(self._components):
            changes.components.add(place)
        if (component.level, component.state) != condition:
            component.since_ns = now_ns
        if component.blocked_by != blocked_by:
            changes.blocked.add(place)
            changes.modes.update(mode.number for mode in component.modes)
        if component.own != own or component.waits != waits:
            alarming.discard(component.plan.id)
            changes.alarms += self._alarm(component, now_ns)
        return self._users[place] if component.passed != passed else ()

    def _alarm(self, component: ComponentState, now_ns: int) -> list[AlarmChange]:
        return self._alarms.update(component.plan.id, now_ns, component.own, component.waits)

    def _transitions(self, now_ns: int, changes: _Changes) -> list[Transition]:
        """Return the transitions of an instant in the order of the plan."""
        found: list[tuple[int, int, Transition | None]] = []
        for number in changes.modes:
            place = self._place_of_mode[number]
            component, mode = self._components[place], self._modes[number]
            found.append((place, number, self._words.mode_transition(component, mode, now_ns)))
        for place in changes.components:
            transition = self._words.component_transition(self._components[place], now_ns)
            found.append((place, len(self._modes), transition))
        found.sort(key=lambda entry: entry[:2])
        return [transition for _, _, transition in found if transition is not None]

    def _tell_all(self, now_ns: int, view: View | None, out: list[Finding]) -> None:
        words = self._words
        for component in self._components:
            for mode in component.modes:
                out.append(words.mode_status(component, mode, now_ns, view))
            out.append(words.component_status(component, now_ns))

    def _tell(self, now_ns: int, view: View, changes: _Changes, out: list[Finding]) -> None:
        words = self._words
        places = changes.components | {self._place_of_mode[number] for number in changes.modes}
        for place in sorted(places):
            component = self._components[place]
            for mode in component.modes:
                if mode.number in changes.modes:
                    out.append(words.mode_status(component, mode, now_ns, view))
            if place in changes.components:
                out.append(words.component_status(component, now_ns))

    def statuses(self) -> list[Status]:
        """Return the newest status of every mode and component, in the order of the plan.

        After ``resume`` numbers are not known until the next whole second.
        """
        found, now_ns = [], self._done_ns
        for component in self._components:
            for mode in component.modes:
                found.append(mode.status or self._words.known_status(component, mode, now_ns))
            found.append(component.status or self._words.component_status(component, now_ns))
        return found

    def alarms(self) -> list[AlarmChange]:
        """Return the alarms that last, as they stand."""
        return self._alarms.standing()

    def command(
        self, action: Action, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> list[AlarmChange]:
        """Do what a person says of an alarm: ``acknowledge``, ``shelve`` (until), ``unshelve``.

        What it returns is ``live_only``. Raises UsageError if there is no such alarm.
        """
        return self._alarms.command(action, alarm_id, who, at_ns, until_ns)

    def snapshot(self) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON, without what the plan tells."""
        done_ns, began_ns = self._done_ns, self._began_ns
        return {
            "version": VERSION,
            "config_hash": self.plan.config_hash,
            "done_ns": done_ns,
            "began_ns": began_ns,
            "outputs": [output.snapshot(done_ns) for output in self._outputs],
            "modes": [mode.snapshot(began_ns) for mode in self._modes],
            "components": [component.snapshot(began_ns) for component in self._components],
            "alarms": self._alarms.snapshot(done_ns),
            "symptoms": self._symptoms.snapshot(),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> bool:
        """Go on from a snapshot; tell whether that was possible.

        Of a snapshot made with another configuration only the alarms are taken: then an epoch
        has to begin.
        """
        if snapshot.get("version") != VERSION:
            return False
        self._alarms.resume(snapshot["alarms"])
        if snapshot["config_hash"] != self.plan.config_hash:
            return False
        self._done_ns, self._began_ns = snapshot["done_ns"], snapshot["began_ns"]
        self._timers = []
        for number, output in enumerate(self._outputs):
            output.resume(snapshot["outputs"][number], self._done_ns)
            self._await(number, output)
        for mode, entry in zip(self._modes, snapshot["modes"], strict=True):
            mode.resume(entry, self._began_ns)
        self._named = {mode.number for mode in self._modes if mode.named}
        for place in self._order:
            entry = snapshot["components"][place]
            self._components[place].resume(entry, self._began_ns, self._components)
        self._symptoms.resume(snapshot.get("symptoms", ()))
        return True


@dataclass(slots=True)
class _Changes:
    """What has changed at an instant.

    ``modes`` (numbers) and ``components`` (places) are to be told; ``places`` are components of
    which modes have changed, ``looked_at`` those whose modes were looked at, ``blocked`` those
    that something else blocks than before. ``outputs`` (numbers) were settled.
    """

    outputs: Collection[int] = ()
    blocked: set[int] = field(default_factory=set)
    modes: set[int] = field(default_factory=set)
    components: set[int] = field(default_factory=set)
    places: set[int] = field(default_factory=set)
    looked_at: set[int] = field(default_factory=set)
    alarms: list[AlarmChange] = field(default_factory=list)
