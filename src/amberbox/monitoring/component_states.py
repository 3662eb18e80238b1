"""States of outputs, modes and components: level, state, reason, and blocking dependencies.

An output is pending, confirmed, healed or flapping; a mode follows from its outputs, a component
from its modes and what it depends on.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.expression import Expression, ExpressionError
from amberbox.core.needs import Needs
from amberbox.core.robot_status import RANK, SEVERITIES, Severity, worst
from amberbox.core.types import Level, Output, Status
from amberbox.monitoring.findings import TICK_NS, HealthState, OutputChange, OutputCondition
from amberbox.monitoring.plan import (
    ComponentPlan,
    DependencyPlan,
    Expectation,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
    Policy,
)

# levels that do not block dependents
FUNCTIONAL: Final[frozenset[Level]] = frozenset(("ok", "warn"))
NOT_MEASURED: Final = "not measured yet"
# what changed of an output: "value" is another bool or text
News: TypeAlias = Literal["none", "other", "value"]
_CODES: Final[tuple[OutputCondition, ...]] = ("ok", "bad", "unknown", "stale")
# snapshot of an output that has been ok for long
_LONG_OK: Final[tuple[Any, ...]] = (0, None, "", False, True, None, 1, [], None, None)


class OutputState:
    """The confirmed condition of an output: a finding counts once it has lasted long enough.

    ``due_ns`` is when the pending finding will count, ``calm_ns`` when flapping ends; None for
    never. ``onset_ns`` is when it began to be bad, whether that counted at once or not.
    """

    __slots__ = (
        *("plan", "mode", "level", "shown", "due_ns", "calm_ns", "onset_ns", "_for_ns", "_heal_ns"),
        *("_flap_ns", "_discrete", "_raw", "_value", "_why", "_fault", "_good", "_ill", "_flips"),
    )

    def __init__(self, plan: OutputPlan, mode: int) -> None:
        self.plan = plan
        self.mode = mode
        self._for_ns = round(plan.for_s * NS)
        self._heal_ns = round(plan.heal_s * NS)
        self._flap_ns = round(plan.flap_s * NS)
        self._discrete = plan.type in ("bool", "string")
        self.begin()

    def begin(self) -> None:
        """Reset: nothing is measured yet."""
        self.level: Level = "unknown"
        self.shown: OutputCondition = "unknown"
        self.due_ns: int | None = None
        self.calm_ns: int | None = None
        self.onset_ns: int | None = None
        self._raw: OutputCondition = "unknown"
        self._value: Output = None
        self._why = NOT_MEASURED
        self._fault: bool | None = None
        self._good: bool | None = None
        self._ill: OutputCondition = "bad"
        self._flips: list[int] = []

    @property
    def value(self) -> Output:
        """Return its last value if it is a bool or a text; numbers are sent with each status."""
        return self._value if self._discrete else None

    @property
    def severity(self) -> Severity:
        """Return the severity of the shown condition."""
        return self.plan.severity if self.shown == "bad" else "urgent"

    @property
    def measured(self) -> str:
        """Return the value when it turned bad, and the expectation; empty if not known."""
        if self._raw != "bad":
            return ""
        if self._why or self.plan.type == "bool" or self._value is None:
            return self._why
        value = f"{self._value} {self.plan.result.unit}".rstrip()
        name = self.plan.name.replace("_", " ")
        return f"{name} is {value}, expected {expected_text(self.plan)}"

    def take(self, found: OutputChange) -> News:
        """Process a finding; return what changed. A changed number alone is no change."""
        at_ns, _, what, value, why = found
        differs = self._discrete and value != self._value
        if what != self._raw:
            self.due_ns = None
            if what == "bad" and self.shown != "bad":
                self.onset_ns = at_ns
            if what == "bad" and self._fault is not True:
                self.due_ns = _tick(at_ns + self._for_ns)
            elif what == "ok" and self._fault is not False:
                self.due_ns = at_ns if self._fault is None else _tick(at_ns + self._heal_ns)
        elif not differs and why == self._why:
            return "none"
        self._value = value if self._discrete else _number_text(value) if what == "bad" else None
        self._raw, self._why = what, why
        return "value" if differs else "other"

    def postpone(self, from_ns: int, to_ns: int) -> bool:
        """Postpone when a change counts by the length of a stall; return whether it was pending."""
        if self.due_ns is None or self.due_ns <= from_ns:
            return False
        self.due_ns = _tick(self.due_ns + to_ns - from_ns)
        return True

    def settle(self, now_ns: int) -> None:
        """Apply a pending change when it is due, and detect flapping."""
        if self.due_ns is not None and now_ns >= self.due_ns:
            self._fault, self.due_ns = self._raw == "bad", None
        if self.calm_ns is not None and now_ns >= self.calm_ns:
            self.calm_ns, self._flips = None, []
        base = self._base()
        if base != "unknown":
            good = base == "ok"
            if not good:
                self._ill = base
            if self._good is not None and good != self._good and self.plan.flaps > 0:
                self._flips = [t for t in self._flips if t >= now_ns - self._flap_ns] + [now_ns]
                self._flips = self._flips[-self.plan.flaps - 1 :]
                if self.calm_ns is not None or len(self._flips) > self.plan.flaps:
                    self.calm_ns = _tick(now_ns + self._flap_ns)
            self._good = good
        self.shown = self._ill if self.calm_ns is not None and base == "ok" else base
        self.level = self._level()

    def _base(self) -> OutputCondition:
        if self._raw in ("unknown", "stale"):
            return self._raw
        if self._fault is None:
            return "unknown"
        return "bad" if self._fault else "ok"

    def _level(self) -> Level:
        if self.shown == "bad":
            return "warn" if self.plan.severity == "warning" else "error"
        return self.shown

    def text(self) -> tuple[str, str]:
        """Return the shown condition as one line: the fact, and the reason if it is known."""
        if self.calm_ns is not None and self.shown != "unknown":
            plan = self.plan
            return f"{plan.name} flapping: {plan.flaps + 1} changes in {plan.flap_s:g} s", ""
        if self._raw == "bad":
            fact = f"{self.plan.name} is {_shown(self._value)}, expected {expected_text(self.plan)}"
            return (fact if self._fault is not None else f"not confirmed yet: {fact}"), self._why
        if self.shown == "bad":
            return f"{self.plan.name} was not as expected less than {self.plan.heal_s:g} s ago", ""
        return self._why, ""

    def snapshot(self, now_ns: int) -> list[Any]:
        """Return the state needed by ``resume``; empty for a number that is ok."""
        flips = [t for t in self._flips if t >= now_ns - self._flap_ns]
        why = None if self._why == NOT_MEASURED else self._why
        entry = [
            _CODES.index(self._raw), self._value, why, self._fault, self._good,
            self.due_ns, _CODES.index(self._ill), flips, self.calm_ns,
            self.onset_ns if ("bad" in (self._raw, self.shown) or self._fault is True) else None,
        ]  # fmt: skip
        while entry and entry[-1] == _LONG_OK[len(entry) - 1]:
            entry.pop()
        return entry

    def resume(self, entry: Sequence[Any], now_ns: int) -> None:
        """Go on from what ``snapshot`` returned at ``now_ns``."""
        full = [*entry, *_LONG_OK[len(entry) :]]
        raw, self._value, why, self._fault, self._good = full[:5]
        self.due_ns, ill, flips, self.calm_ns, self.onset_ns = full[5:]
        self._raw, self._ill = _CODES[raw], _CODES[ill]
        self._why = NOT_MEASURED if why is None else why
        self._flips = list(flips)
        self.settle(now_ns)


def highest(severities: Iterable[Severity]) -> Severity:
    """Return the highest of some severities; ``urgent`` of none."""
    return max(severities, key=SEVERITIES.index, default="urgent")


def expected_text(plan: OutputPlan) -> str:
    """Return the expectation of an output as text."""
    if plan.expectation.value is None and plan.type == "bool":
        return str(Expectation(plan.result.nominal))
    return str(plan.expectation)


def _number_text(value: Output) -> str | None:
    """Return a number as text for a reason; None if it is no number."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return None if value is None else str(value)


def _shown(value: Output) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "not known" if value is None else str(value)


def _tick(time_ns: int) -> int:
    """Return the first instant at or after a time."""
    return -(-time_ns // TICK_NS) * TICK_NS


_NO_OUTPUTS = "it has no outputs"


class ModeState:
    """The state of a mode. ``number`` is its index in ``plan.modes()``.

    ``emitted`` is the condition after the last transition; ``awaited`` is true from the beginning
    of an epoch until something is known. A mode that does not run stays unknown.
    """

    __slots__ = (
        *(
            "plan",
            "number",
            "outputs",
            "level",
            "state",
            "reason",
            "since_ns",
            "emitted",
            "awaited",
        ),
        *("status", "blank", "runs"),
    )

    def __init__(self, plan: ModePlan, number: int, outputs: Sequence[OutputState]) -> None:
        self.plan = plan
        self.number = number
        self.outputs = outputs
        self.blank: Mapping[str, Output] = {output.plan.name: None for output in outputs}
        self.level: Level = "unknown"
        self.state = "unknown"
        self.runs = bool(outputs) and not plan.problem
        self.reason = plan.problem or (NOT_MEASURED if outputs else _NO_OUTPUTS)
        self.since_ns = 0
        self.emitted: HealthState | None = None
        self.awaited = True
        self.status: Status | None = None

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is measured yet."""
        for output in self.outputs:
            output.begin()
        self.since_ns, self.awaited, self.status = at_ns, True, None
        if self.runs:
            self.level, self.state, self.reason = "unknown", "unknown", NOT_MEASURED

    def judge(self, values: Mapping[str, Output]) -> bool:
        """Evaluate the outputs again; return whether level, state or reason have changed.

        ``values`` are for the conditions of ``states:`` and needed only if there are any.
        """
        if not self.runs:
            return False
        before = self.level, self.state, self.reason
        if len(self.outputs) == 1:
            self.level = self.outputs[0].level
        else:
            self.level = worst(output.level for output in self.outputs)
        self.reason = "" if self.level == "ok" else self._reason()
        self.state = self._state(values)
        return before != (self.level, self.state, self.reason)

    def _state(self, values: Mapping[str, Output]) -> str:
        if self.level == "ok":
            return "nominal"
        if self.level in ("unknown", "stale"):
            return self.level
        for name, condition in self.plan.states.items():
            if _holds(condition, values):
                return name
        return next(o.plan.name for o in self.outputs if o.level == self.level)

    def _reason(self) -> str:
        shown = [output for output in self.outputs if output.level == self.level]
        shown += [o for o in self.outputs if o.shown == "bad" and o.level != self.level]
        return join_facts(output.text() for output in shown)

    @property
    def named(self) -> bool:
        """Return whether its state now depends on conditions over its outputs."""
        return bool(self.plan.states) and self.level in ("warn", "error")

    def hints(self) -> Iterable[str]:
        """Return what can be done about outputs that are not as expected."""
        return (o.plan.hint for o in self.outputs if o.shown == "bad" and o.plan.hint)

    def known_values(self) -> Mapping[str, Output]:
        """Return the values known without the engine: bools and texts."""
        return {output.plan.name: output.value for output in self.outputs}

    def take_transition(self) -> tuple[HealthState | None, HealthState]:
        """Return the condition before and now if that is a transition; None as before if not.

        The last condition before an epoch is compared with the first known one in it.
        """
        before, after = self.emitted, HealthState(self.level, self.state)
        if self.awaited and self.level == "unknown":
            return None, after
        self.awaited, self.emitted = False, after
        if before is None:
            before = after if self.level == "ok" else HealthState("unknown", "unknown")
        return (None if before == after else before), after

    def snapshot(self, began_ns: int) -> list[Any]:
        """Return the state needed by ``resume``, without the outputs."""
        emitted = None if self.emitted is None else list(self.emitted)
        same = self.emitted == (self.level, self.state)
        entry = [self.since_ns - began_ns, self.state if self.named else None, self.awaited]
        return entry if same else [*entry, emitted]

    def resume(self, entry: Sequence[Any], began_ns: int) -> None:
        """Go on from what ``snapshot`` returned; the outputs have been resumed before."""
        since, state, self.awaited, *emitted = entry
        self.since_ns, self.status = began_ns + since, None
        self.judge({})
        self.state = self.state if state is None else state
        self.emitted = HealthState(self.level, self.state)
        if emitted:
            self.emitted = None if emitted[0] is None else HealthState(*emitted[0])


def join_facts(texts: Iterable[tuple[str, str]]) -> str:
    """Join facts to one line; facts in a row that have the same cause share it."""
    parts = []
    for why, group in groupby(dict.fromkeys(texts), key=lambda text: text[1]):
        facts = "; ".join(fact for fact, _ in group)
        parts.append(f"{facts}: {why}" if why else facts)
    return "; ".join(parts)


def _holds(condition: Expression, values: Mapping[str, Output]) -> bool:
    """Return whether a condition holds; false where its values have the wrong type."""
    try:
        return condition.evaluate(values) is True
    except ExpressionError:
        return False


_LONGEST = 4


class Blocker(NamedTuple):
    """A dependency that is not ok. ``label`` is a component or ``component/mode``.

    ``link`` is the reason, along the chain of its own blockers; ``end`` is the last of them,
    ``steps`` away. It is ``faulty`` if it has a known fault, and is not only unknown.
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
    """A dependency whose state one of its modes gives, or one output."""

    label: str
    mode: ModeState
    output: OutputState | None

    def blocking(self) -> tuple[Blocker, ...]:
        """Return its blockers: nothing if it is ok."""
        level = self.mode.level if self.output is None else self.output.level
        if level in FUNCTIONAL:
            return ()
        return (blocker(self.label, level, self.mode.reason, level in ("error", "stale"), ()),)


# returns what a component (place) blocks others with
PassedBlockers: TypeAlias = Callable[[int], Sequence[Blocker]]


@dataclass(slots=True)
class DependencyJudges:
    """The required dependencies: components (by index), and modes."""

    components: list[int] = field(default_factory=list)
    modes: list[JudgedByMode] = field(default_factory=list)

    def blocking(self, passed: PassedBlockers) -> list[Blocker]:
        """Return all that is not ok."""
        found = [b for place in dict.fromkeys(self.components) for b in passed(place)]
        return found + [b for judge in dict.fromkeys(self.modes) for b in judge.blocking()]


@dataclass(frozen=True, slots=True)
class DependencyGate:
    """A group of dependencies of which at least a number are required."""

    at_least: int
    parts: tuple[DependencyGate | DependencyJudges, ...]

    def blocking(self, passed: PassedBlockers) -> list[Blocker]:
        """Return the parts that are not ok, if too few of them are ok."""
        found = [part.blocking(passed) for part in self.parts]
        if sum(not blockers for blockers in found) >= self.at_least:
            return []
        return [b for blockers in found for b in blockers]


@dataclass(frozen=True, slots=True)
class DependencyEdges:
    """The dependencies of a component: ``sources`` are the relevant components (by index).

    For ``components`` among them, their own blockers matter. ``notes`` name dependencies without a
    monitor: they never block.
    """

    needs: DependencyGate | DependencyJudges
    components: frozenset[int]
    sources: frozenset[int]
    notes: tuple[str, ...]


def edges_of(
    component: ComponentPlan,
    places: Mapping[str, int],
    modes: Mapping[tuple[str, str], ModeState],
    allowed: frozenset[int],
) -> DependencyEdges:
    """Return the dependencies of a component among the components in ``places``."""
    by_name: dict[str, DependencyJudges] = {}
    components, sources, open_names = set(), set(), []
    whole = DependencyJudges()
    for dependency in component.dependencies:
        place = _place(dependency, places)
        mode = modes.get((dependency.component or "", dependency.mode))
        if place is None or (dependency.mode and mode is None):
            open_names.append(dependency.name)
        elif place in allowed:
            own = whole if component.needs is None else DependencyJudges()
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
    return DependencyEdges(needs, frozenset(components), frozenset(sources), notes)


def _gate(needs: Needs, by_name: Mapping[str, DependencyJudges]) -> DependencyGate:
    """Replace names by their modes or components; a dependency without a monitor counts as ok."""
    parts = (
        by_name.get(part, DependencyJudges()) if isinstance(part, str) else _gate(part, by_name)
        for part in needs.parts
    )
    return DependencyGate(needs.at_least, tuple(parts))


def _place(dependency: DependencyPlan, places: Mapping[str, int]) -> int | None:
    if dependency.problem or not dependency.judged or dependency.component is None:
        return None
    return places.get(dependency.component)


def _judge(dependency: DependencyPlan, mode: ModeState) -> JudgedByMode:
    output = next((o for o in mode.outputs if o.plan.name == dependency.output), None)
    return JudgedByMode(f"{dependency.component}/{dependency.mode}", mode, output)


def in_order(plan: MonitoringPlan) -> list[int]:
    """Return the indices of all components, dependencies first, else in the order of the plan.

    In a cycle, which the configuration refuses, its first component comes first.
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
    """Return the blockers as text, along the chain."""
    return "waits for " + ", and for ".join(wait.link for wait in waits)


_MOST_DESCRIBED = 3  # dependencies described in a reason; ``blocked_by`` names all


class OwnState(NamedTuple):
    """The state of a component by its own modes alone, independent of its dependencies."""

    level: Level
    state: str
    reason: str
    severity: Severity


NO_MONITOR = OwnState("unknown", "not_monitored", "no monitor", "urgent")


class ComponentState:
    """The state of a component.

    ``own`` is its state by its modes, ``waits`` its blockers, ``passed`` those it passes on.
    """

    __slots__ = (
        *("plan", "modes", "edges", "own", "level", "state", "reason", "since_ns", "emitted"),
        *("initialised", "waits", "blocked_by", "passed", "status"),
    )

    def __init__(
        self, plan: ComponentPlan, modes: Sequence[ModeState], edges: DependencyEdges
    ) -> None:
        self.plan = plan
        self.modes = modes
        self.edges = edges
        self.emitted: HealthState | None = None
        self.begin(0)

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: it is not initialised."""
        self.own = NO_MONITOR
        self.level: Level = "unknown"
        self.state = self.reason = ""
        self.since_ns = at_ns
        self.initialised = False
        self.waits: tuple[Blocker, ...] = ()
        self.blocked_by: tuple[str, ...] = ()
        self.passed: tuple[Blocker, ...] = ()
        self.status: Status | None = None
        self.judge_modes()

    @property
    def monitored(self) -> bool:
        """Return whether it has modes of its own; otherwise its dependencies count in its place."""
        return bool(self.modes)

    def judge_modes(self) -> None:
        """Combine the modes, some of which have changed."""
        if self.modes:
            self.own = combine_modes(self.modes, self.plan.policy)

    def judge(self, components: Sequence[ComponentState]) -> bool:
        """Evaluate modes and dependencies; return whether level, state or reason have changed."""
        before = self.level, self.state, self.reason, self.blocked_by
        self._look_at_edges(components)
        own = self.own
        if self.monitored and own.level in FUNCTIONAL and not self.waits:
            self.initialised = True
        if self.initialised or not self.monitored:
            self.level, self.state, reason = own.level, own.state, own.reason
        else:
            self.level = "error" if own.level == "error" else "unknown"
            self.state, reason = "not_initialised", self._waiting()
        notes = self.edges.notes
        self.reason = "; ".join(filter(None, (reason, *notes))) if notes else reason
        self.passed = self._passed()
        return before != (self.level, self.state, self.reason, self.blocked_by)

    def _look_at_edges(self, components: Sequence[ComponentState]) -> None:
        if not self.edges.sources:
            return
        found = self.edges.needs.blocking(lambda place: components[place].passed)
        by_label = {b.label: b for b in reversed(found)}
        labels = tuple(dict.fromkeys(b.label for b in found))
        self.waits, self.blocked_by = tuple(by_label[label] for label in labels), labels

    def _waiting(self) -> str:
        """Return why it is not initialised."""
        own = self.own
        if not self.waits:
            return own.reason or NOT_MEASURED
        text = waiting_text(self.waits[:_MOST_DESCRIBED])
        if len(self.waits) > _MOST_DESCRIBED:
            text += f", and {len(self.waits) - _MOST_DESCRIBED} more"
        return f"{text}; {own.reason}" if own.level in ("warn", "stale", "error") else text

    def _passed(self) -> tuple[Blocker, ...]:
        """Return the blockers for its dependents: itself, or its own blockers if it is ok."""
        if not self.monitored or self.level in FUNCTIONAL:
            return self.waits
        words = self.state.replace("_", " ")
        faulty = self.own.level in ("error", "stale")
        return (blocker(self.plan.id, words, self.own.reason, faulty, self.waits),)

    def hint(self) -> str:
        """Return what can be done about its outputs that are not as expected."""
        return "; ".join(dict.fromkeys(hint for mode in self.modes for hint in mode.hints()))

    def snapshot(self, began_ns: int) -> list[Any]:
        """Return the state needed by ``resume``, without the modes."""
        return [self.since_ns - began_ns, self.initialised]

    def resume(
        self, entry: Sequence[Any], began_ns: int, components: Sequence[ComponentState]
    ) -> None:
        """Go on from what ``snapshot`` returned; modes and dependencies have been resumed."""
        since, self.initialised = entry
        self.since_ns, self.status = began_ns + since, None
        self.judge_modes()
        self.judge(components)
        self.emitted = HealthState(self.level, self.state)


def combine_modes(modes: Sequence[ModeState], policy: Policy) -> OwnState:
    """Combine modes by policy: all must be ok, any, or more than half."""
    level = _combined([mode.level for mode in modes], policy)
    if all(mode.level == "ok" for mode in modes):
        return OwnState("ok", "nominal", "", "warning")
    failing = [mode for mode in modes if mode.level == level] if level != "ok" else []
    named = ("warn", "error") if level not in FUNCTIONAL else ("warn", "error", "stale", "unknown")
    failing += [mode for mode in modes if mode.level != level and mode.level in named]
    reason = "; ".join(dict.fromkeys(mode.reason for mode in failing if mode.reason))
    if level in FUNCTIONAL and any(mode.level not in FUNCTIONAL for mode in modes):
        count = sum(mode.level in FUNCTIONAL for mode in modes)
        reason = f"{count} of {len(modes)} modes are ok: {reason}"
    state = "nominal" if level == "ok" else failing[0].state
    shown = [o for mode in failing for o in mode.outputs if o.level not in ("ok", "unknown")]
    return OwnState(level, state, reason, highest([output.severity for output in shown]))


def _combined(levels: Sequence[Level], policy: Policy) -> Level:
    if policy == "any":
        known = [level for level in levels if level not in ("unknown", "stale")]
        return min(known, key=RANK.__getitem__) if known else worst(levels)
    if policy == "majority":
        if 2 * sum(level == "ok" for level in levels) > len(levels):
            return "ok"
        if 2 * sum(level in FUNCTIONAL for level in levels) > len(levels):
            return "warn"
    return worst(levels)
