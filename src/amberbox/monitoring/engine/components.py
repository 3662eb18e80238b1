"""What a component's modes and dependencies make of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from amberbox.core.types import Level, Status
from amberbox.monitoring.engine.edges import Blocker, Edges, blocker, waiting_text
from amberbox.monitoring.engine.findings import Condition
from amberbox.monitoring.engine.modestate import ModeState
from amberbox.monitoring.engine.outputs import FUNCTIONAL, NOT_MEASURED, RANK, highest, worst
from amberbox.monitoring.plan import ComponentPlan, Policy, Severity

_MOST = 3
"""So many dependencies are described in a reason; ``blocked_by`` names all."""


class Own(NamedTuple):
    """What a component's modes say of it, whatever it depends on."""

    level: Level
    state: str
    reason: str
    severity: Severity


NO_MONITOR = Own("unknown", "not_monitored", "no monitor", "urgent")


class ComponentState:
    """A component as it stands.

    ``own`` is what its modes say, ``waits`` what blocks it, ``passed`` what it blocks others with.
    """

    __slots__ = (
        *("plan", "modes", "edges", "own", "level", "state", "reason", "since_ns", "told"),
        *("initialised", "waits", "blocked_by", "passed", "status"),
    )

    def __init__(self, plan: ComponentPlan, modes: Sequence[ModeState], edges: Edges) -> None:
        self.plan = plan
        self.modes = modes
        self.edges = edges
        self.told: Condition | None = None
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
        """Tell whether it has modes of its own; else what it depends on counts in its place."""
        return bool(self.modes)

    def judge_modes(self) -> None:
        """Combine the modes, some of which have changed."""
        if self.modes:
            self.own = combine(self.modes, self.plan.policy)

    def judge(self, components: Sequence[ComponentState]) -> bool:
        """Look at modes and dependencies; tell whether what it says differs from before."""
        before = self.level, self.state, self.reason, self.blocked_by
        self._look_at_edges(components)
        self._set_condition()
        self.passed = self._passed()
        return before != (self.level, self.state, self.reason, self.blocked_by)

    def _look_at_edges(self, components: Sequence[ComponentState]) -> None:
        if not self.edges.sources:
            return
        found = self.edges.needs.blocking(lambda place: components[place].passed)
        by_label = {b.label: b for b in reversed(found)}
        labels = tuple(dict.fromkeys(b.label for b in found))
        self.waits, self.blocked_by = tuple(by_label[label] for label in labels), labels

    def _set_condition(self) -> None:
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

    def _waiting(self) -> str:
        """Say why it is not initialised."""
        own = self.own
        if not self.waits:
            return own.reason or NOT_MEASURED
        text = waiting_text(self.waits[:_MOST])
        if len(self.waits) > _MOST:
            text += f", and {len(self.waits) - _MOST} more"
        return f"{text}; {own.reason}" if own.level in ("warn", "stale", "error") else text

    def _passed(self) -> tuple[Blocker, ...]:
        """Return what it blocks others with: itself, or what blocks it if it is ok itself."""
        if not self.monitored or self.level in FUNCTIONAL:
            return self.waits
        words = self.state.replace("_", " ")
        faulty = self.own.level in ("error", "stale")
        return (blocker(self.plan.id, words, self.own.reason, faulty, self.waits),)

    def hint(self) -> str:
        """Return what can be done about its outputs that are not as expected."""
        return "; ".join(dict.fromkeys(hint for mode in self.modes for hint in mode.hints()))

    def snapshot(self, began_ns: int) -> list[Any]:
        """Return what has to be known to go on, beside the modes."""
        return [self.since_ns - began_ns, self.initialised]

    def resume(
        self, entry: Sequence[Any], began_ns: int, components: Sequence[ComponentState]
    ) -> None:
        """Go on from what ``snapshot`` returned; modes and dependencies have been resumed."""
        since, self.initialised = entry
        self.since_ns, self.status = began_ns + since, None
        self.judge_modes()
        self.judge(components)
        self.told = Condition(self.level, self.state)


def combine(modes: Sequence[ModeState], policy: Policy) -> Own:
    """Combine modes by policy: all must be ok, any, or more than half."""
    level = _combined([mode.level for mode in modes], policy)
    if all(mode.level == "ok" for mode in modes):
        return Own("ok", "nominal", "", "warning")
    failing = [mode for mode in modes if mode.level == level] if level != "ok" else []
    failing += [m for m in modes if m.level not in ("ok", level) and _counts(m.level, level)]
    reason = "; ".join(dict.fromkeys(mode.reason for mode in failing if mode.reason))
    if level in FUNCTIONAL and any(mode.level not in FUNCTIONAL for mode in modes):
        count = sum(mode.level in FUNCTIONAL for mode in modes)
        reason = f"{count} of {len(modes)} modes are ok: {reason}"
    state = "nominal" if level == "ok" else failing[0].state
    return Own(level, state, reason, highest(_severities(failing)))


def _counts(level: Level, combined: Level) -> bool:
    """Tell whether a mode of another level than the component's is named in the reason."""
    return combined in FUNCTIONAL or level in ("warn", "error")


def _severities(modes: Sequence[ModeState]) -> list[Severity]:
    shown = [o for mode in modes for o in mode.outputs if o.level not in ("ok", "unknown")]
    return [output.severity for output in shown]


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
