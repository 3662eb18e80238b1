"""What components and modes are called in messages: as their files have it, else by their ids."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from amberbox.core.types import Status
from amberbox.monitoring.plan import ComponentPlan, ModePlan, Plan


@dataclass(frozen=True, slots=True)
class Naming:
    """The names of a plan; without one everything goes by its id."""

    components: Mapping[str, ComponentPlan] = field(default_factory=dict)
    modes: Mapping[tuple[str, str], ModePlan] = field(default_factory=dict)

    @classmethod
    def of(cls, plan: Plan | None) -> Naming:
        """Collect the names of a plan."""
        if plan is None:
            return cls()
        components = {component.id: component for component in plan.components}
        return cls(components, {(c.id, mode.id): mode for c, mode in plan.modes()})

    def component(self, status: Status) -> str:
        """Describe a status' component, as its file does."""
        known = self.components.get(status.component)
        return (known.description or known.name) if known else status.component

    def monitor(self, status: Status) -> str:
        """Name a status' mode: ``name`` of its file."""
        known = self.modes.get((status.component, status.mode))
        return known.name if known else status.mode

    def monitor_description(self, status: Status) -> str:
        """Describe a status' mode."""
        known = self.modes.get((status.component, status.mode))
        return known.description if known else ""
