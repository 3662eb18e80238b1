"""Statuses and transitions of modes and components as they stand at an instant."""

from __future__ import annotations

from dataclasses import dataclass, replace

from amberbox.core.types import Status
from amberbox.monitoring.engine.components import ComponentState
from amberbox.monitoring.engine.findings import Condition, Transition, View
from amberbox.monitoring.engine.modestate import ModeState


@dataclass(frozen=True, slots=True)
class Words:
    """Puts findings about a robot into records; each status is kept as the newest."""

    robot: str
    config_hash: str

    def mode_status(
        self, component: ComponentState, mode: ModeState, now_ns: int, view: View | None
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
        """Return the transition that a mode has made since it was last asked, if any."""
        before, after = mode.tell()
        if before is None:
            return None
        hint = "; ".join(dict.fromkeys(mode.hints()))
        return Transition(
            self.robot, component.plan.id, mode.plan.id, before, after, now_ns,
            mode.reason, component.blocked_by, hint, self.config_hash,
        )  # fmt: skip

    def component_transition(self, component: ComponentState, now_ns: int) -> Transition | None:
        """Return the transition that a component has made since it was last asked, if any."""
        before, after = component.told, Condition(component.level, component.state)
        component.told = after
        if before is None or before == after:
            return None
        return Transition(
            self.robot, component.plan.id, "", before, after, now_ns,
            component.reason, component.blocked_by, component.hint(), self.config_hash,
        )  # fmt: skip
