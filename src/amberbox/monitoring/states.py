"""The state machine of a robot: from conditions of outputs to statuses, symptoms and alarms."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.types import Output, Status, Symptom, SymptomState
from amberbox.monitoring.alarms import NEVER_NS, ComponentAlarms, PersonAction
from amberbox.monitoring.component_states import (
    ComponentState,
    ModeState,
    OutputState,
    edges_of,
    in_order,
)
from amberbox.monitoring.findings import (
    AlarmChange,
    Finding,
    HealthState,
    OutputChange,
    OutputCondition,
    OutputValues,
    Transition,
)
from amberbox.monitoring.plan import MonitoringPlan, OutputPlan, measured_from

_STATE: Final[Mapping[OutputCondition, SymptomState]] = {
    **{"ok": "absent", "bad": "present"},
    **{"unknown": "unknown", "stale": "unknown"},
}

# state of a symptom, and what blocks its component
SymptomCondition: TypeAlias = tuple[SymptomState, tuple[str, ...]]


class _Watched:
    """An output with an expected value; ``last`` is None until a symptom was emitted."""

    __slots__ = ("address", "component", "last", "measured", "output")

    def __init__(
        self, address: str, component: ComponentState, output: OutputState, measured: Sequence[str]
    ) -> None:
        self.address = address
        self.component = component
        self.output = output
        self.measured = measured
        self.last: SymptomCondition | None = None

    def now(self) -> SymptomCondition:
        """Return its state now, and what blocks its component."""
        return _STATE[self.output.shown], self.component.blocked_by

    def emit(self, now_ns: int) -> Symptom | None:
        """Return the symptom if it differs from the last one emitted."""
        now = self.now()
        if now == self.last or (self.last is None and not _begins_epoch(now)):
            return None
        self.last = now
        state, blocked_by = now
        onset_ns = self.output.onset_ns if state == "present" else None
        evidence: tuple[tuple[str, int, int], ...] = ()
        if onset_ns is not None:
            evidence = tuple((address, onset_ns, now_ns) for address in self.measured)
        return Symptom(
            self.address, state, self.address, onset_ns, now_ns, evidence=evidence,
            blocked_by=blocked_by, reason=self.output.measured if state == "present" else "",
        )  # fmt: skip


class SymptomEmitter:
    """The symptoms of a robot's monitors, by the numbers of outputs."""

    def __init__(self, components: Sequence[ComponentState]) -> None:
        """Watch the outputs of components, numbered in order."""
        self._watched: dict[int, _Watched] = {}
        self._of_component: list[list[int]] = []
        number = 0
        for component in components:
            self._of_component.append([])
            for mode in component.modes:
                inputs = [
                    measured_from(m, output) for m in mode.plan.mappings for output in m.outputs
                ]
                for output, measured in zip(mode.outputs, inputs, strict=True):
                    if mode.runs and output.plan.expectation.value is not None:
                        address = f"{component.plan.id}/{mode.plan.id}/{output.plan.name}"
                        self._watched[number] = _Watched(address, component, output, measured)
                        self._of_component[-1].append(number)
                    number += 1

    def emit(self, outputs: Iterable[int], components: Iterable[int], now_ns: int) -> list[Symptom]:
        """Return changed symptoms of some outputs (numbers) and of all of components (places)."""
        numbers = {number for number in outputs if number in self._watched}
        for place in components:
            numbers.update(self._of_component[place])
        emitted = (self._watched[number].emit(now_ns) for number in sorted(numbers))
        return [symptom for symptom in emitted if symptom is not None]

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch, in which nothing is known yet; return the symptoms that change by it."""
        emitted = self.emit(self._watched, (), at_ns)
        for watched in self._watched.values():
            watched.last = None
        return emitted

    def snapshot(self) -> list[int]:
        """Return the numbers of outputs whose last symptom could not begin an epoch."""
        return [
            number
            for number, watched in self._watched.items()
            if watched.last is not None and not _begins_epoch(watched.last)
        ]

    def resume(self, numbers_with_state: Iterable[int]) -> None:
        """Go on from what ``snapshot`` returned; outputs and components have been resumed."""
        had_one = set(numbers_with_state)
        for number, watched in self._watched.items():
            now = watched.now()
            watched.last = now if _begins_epoch(now) or number in had_one else None


def _begins_epoch(last: SymptomCondition) -> bool:
    """Return whether an epoch may begin with this symptom: it is evidence on a fault."""
    state, blocked_by = last
    return state == "present" or (state == "absent" and not blocked_by)


@dataclass(frozen=True, slots=True)
class _StatusBuilder:
    """Builds statuses and transitions of a robot; keeps the newest status of each."""

    robot: str
    config_hash: str

    def mode_status(
        self, component: ComponentState, mode: ModeState, now_ns: int, view: OutputValues | None
    ) -> Status:
        """Return the status of a mode; without a view no values are known."""
        values = mode.blank if view is None or not mode.runs else view.outputs(mode.number, now_ns)
        mode.status = status = Status(
            self.robot, component.plan.id, mode.plan.id, mode.level, mode.state, values,
            component.blocked_by, now_ns, mode.since_ns, mode.reason, self.config_hash,
        )  # fmt: skip
        return status

    def known_status(self, component: ComponentState, mode: ModeState, now_ns: int) -> Status:
        """Return the status of a mode with the bools and texts that are known without a view."""
        status = self.mode_status(component, mode, now_ns, None)
        mode.status = status = replace(status, outputs=mode.known_values())
        return status

    def component_status(self, component: ComponentState, now_ns: int) -> Status:
        """Return the status of a component."""
        component.status = status = Status(
            self.robot, component.plan.id, "", component.level, component.state, {},
            component.blocked_by, now_ns, component.since_ns, component.reason, self.config_hash,
        )  # fmt: skip
        return status

    def mode_transition(
        self, component: ComponentState, mode: ModeState, now_ns: int
    ) -> Transition | None:
        """Return the transition of a mode since the last call, if any."""
        before, after = mode.take_transition()
        if before is None:
            return None
        hint = "; ".join(dict.fromkeys(mode.hints()))
        return Transition(
            self.robot, component.plan.id, mode.plan.id, before, after, now_ns,
            mode.reason, component.blocked_by, hint, self.config_hash,
        )  # fmt: skip

    def component_transition(self, component: ComponentState, now_ns: int) -> Transition | None:
        """Return the transition of a component since the last call, if any."""
        before, after = component.emitted, HealthState(component.level, component.state)
        component.emitted = after
        if before is None or before == after:
            return None
        return Transition(
            self.robot, component.plan.id, "", before, after, now_ns,
            component.reason, component.blocked_by, component.hint(), self.config_hash,
        )  # fmt: skip


VERSION: Final = 1
_NOTHING: Final[Mapping[str, Output]] = MappingProxyType({})


class OutputPlace(NamedTuple):
    """The place of an output; its number is its index in ``outputs_of``."""

    component: str
    mode: str
    output: OutputPlan


def outputs_of(plan: MonitoringPlan) -> list[OutputPlace]:
    """Return all outputs of a plan in order."""
    return [
        OutputPlace(component.id, mode.id, output)
        for component, mode in plan.modes()
        for output in mode.outputs
    ]


class RobotStates:
    """The states of all components and modes: ``begin`` an epoch, then ``advance``.

    It reads no clock. How findings are split into calls does not matter.
    """

    def __init__(self, plan: MonitoringPlan) -> None:
        self.plan = plan
        self._words = _StatusBuilder(plan.robot, plan.config_hash)
        self._outputs: list[OutputState] = []
        self._modes: list[ModeState] = []
        self._components: list[ComponentState] = []
        self._build()
        self._symptoms = SymptomEmitter(self._components)
        self._alarms = ComponentAlarms(plan.robot, plan.config_hash)
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
            states = [OutputState(entry, number) for entry in mode.outputs]
            self._outputs += states
            self._modes.append(ModeState(mode, number, states))
        known = {
            (self.plan.components[place].id, mode.plan.id): mode
            for place, mode in zip(self._place_of_mode, self._modes, strict=True)
        }
        self._connect(known)

    def _connect(self, known: Mapping[tuple[str, str], ModeState]) -> None:
        """Make the components, and record which ones depend on which."""
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

        Alarms stay, except those of components that are not in the plan any more.
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
        self._emit_all(at_ns, None, findings)
        return findings

    def advance(
        self, found: Sequence[OutputChange], until_ns: int, view: OutputValues
    ) -> list[Finding]:
        """Return the findings that follow from ``found``, in order of time, up to ``until_ns``.

        ``found`` is sorted by time, after the last ``until_ns`` and not after this one.
        """
        findings: list[Finding] = []
        taken = 0
        second_ns = (self._done_ns // NS + 1) * NS
        while True:
            next_ns = self._timers[0][0] if self._timers else NEVER_NS
            now_ns = min(second_ns, max(min(next_ns, self._alarms.next_ns()), self._done_ns))
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

    def postpone(self, from_ns: int, to_ns: int) -> None:
        """Postpone pending changes by a stall of the recorder, in which nothing is known."""
        for number, output in enumerate(self._outputs):
            if output.postpone(from_ns, to_ns):
                self._await(number, output)

    def _instant(
        self,
        now_ns: int,
        found: Sequence[OutputChange],
        view: OutputValues,
        full: bool,
        out: list[Finding],
    ) -> None:
        changes = _Changes()
        again, changes.alarms = self._alarms.due(now_ns)
        touched = self._take(now_ns, found, changes) if found or self._timers else set()
        if full and self._named:
            touched |= self._named
        if touched or again:
            for number in sorted(touched):
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
            self._judge_components(now_ns, again, changes)
            out += self._transitions(now_ns, changes)
        out += changes.alarms
        out += self._symptoms.emit(changes.outputs, changes.blocked, now_ns)
        if full:
            self._emit_all(now_ns, view, out)
        elif changes.modes or changes.components:
            self._emit_changes(now_ns, view, changes, out)

    def _take(self, now_ns: int, found: Sequence[OutputChange], changes: _Changes) -> set[int]:
        """Apply changes of outputs, and pending ones that are due; return the modes to evaluate."""
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

    def _judge_components(self, now_ns: int, again: Iterable[str], changes: _Changes) -> None:
        """Evaluate components whose modes have changed, then their dependents, in order."""
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
        """Evaluate a component; return the ranks of the dependents to evaluate next."""
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

    def _emit_all(self, now_ns: int, view: OutputValues | None, out: list[Finding]) -> None:
        words = self._words
        for component in self._components:
            for mode in component.modes:
                out.append(words.mode_status(component, mode, now_ns, view))
            out.append(words.component_status(component, now_ns))

    def _emit_changes(
        self, now_ns: int, view: OutputValues, changes: _Changes, out: list[Finding]
    ) -> None:
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
        """Return the active alarms in their present state."""
        return self._alarms.active()

    def command(self, alarm_id: str, done: PersonAction) -> list[AlarmChange]:
        """Apply a person's action to an alarm.

        The changes returned are ``live_only``. Raises UsageError if there is no such alarm.
        """
        return self._alarms.command(alarm_id, done)

    def snapshot(self) -> dict[str, Any]:
        """Return the state needed by ``resume``, as JSON, without the plan."""
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
        """Go on from a snapshot; return whether that was possible.

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
    """The changes at an instant.

    ``modes`` (numbers) and ``components`` (indices) get a status; ``places`` are components whose
    modes have changed, ``looked_at`` those whose modes were evaluated, ``blocked`` those whose
    blockers have changed. ``outputs`` (numbers) were settled.
    """

    outputs: Collection[int] = ()
    blocked: set[int] = field(default_factory=set)
    modes: set[int] = field(default_factory=set)
    components: set[int] = field(default_factory=set)
    places: set[int] = field(default_factory=set)
    looked_at: set[int] = field(default_factory=set)
    alarms: list[AlarmChange] = field(default_factory=list)
