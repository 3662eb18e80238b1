"""What component files and mode files may say, key by key (the paper's listings 4 and 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.monitoring.plan import Policy, Severity

STATES = ("nominal", "unknown", "stale", "not_initialised", "not_monitored")
"""States that everything may be in: a fault is called otherwise."""

OutputType = Literal["bool", "int", "float", "double", "string"]

LEGACY_KEYS: Mapping[str, str] = {
    "monitor_name": "ignored: the mode files say which monitors there are",
    "mappings.map_outputs": "ignored: outputs are bound by name, by 'result:', or in order",
}
"""Path of a key, without the places in lists, to the note that is shown."""


def legacy_note(path: str) -> str | None:
    """Return the note for a key of older files, None for a key that was never known."""
    return LEGACY_KEYS.get(path)


@dataclass(frozen=True)
class FlappingOptions:
    """When an output that comes and goes is called flapping."""

    changes: int = option(6, "more changes than this")
    within: float = option(60.0, "in this time", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        for key in ("changes", "within"):
            if getattr(self, key) <= 0:
                yield key, "must be above 0"


@dataclass(frozen=True)
class OutputOptions:
    """One output of a mode: what it is, what it should be, and what it means if it is not."""

    name: str = option(doc="name of the output")
    type: OutputType = option(doc="what its values are")
    expected: Any = option(None, "what it should be: a value, '>= 50', '2 .. 8', {min: 2, max: 8}")
    result: str = option("", "result of the monitor that it shows; else by name, else by type")
    unit: str = option("", "unit of its numbers, for people; else what the monitor says")
    severity: Severity = option("urgent", "what it means for the robot if it is not as expected")
    for_s: float = option(
        0.0, "how long it must be bad before it counts", unit="s", aliases=["for"]
    )
    heal_s: float = option(
        0.0, "how long it must be good before it is healed", unit="s", aliases=["heal"]
    )
    flapping: FlappingOptions = option(FlappingOptions(), "when it is called flapping")
    description: str = option("", "what it is, for people")
    hint: str = option("", "what to do if it is not as expected")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        if not self.name.strip() or any(sign in self.name.strip() for sign in "/ \t:#"):
            yield "name", f"'{self.name}' cannot be part of an address: leave out blanks and / : #"
        if self.name.strip() in STATES:
            yield "name", f"'{self.name}' is a state of its own; faults are called after outputs"
        for key in ("for_s", "heal_s"):
            if not 0 <= getattr(self, key) < float("inf"):
                yield key, "must be 0 or more"


@dataclass(frozen=True)
class MappingOptions:
    """Inputs of a mode and the outputs that are made of them."""

    inputs: Sequence[str] = option((), "items, variables, topics, or subjects of probes")
    outputs: Sequence[OutputOptions] = option((), "what is found out")


@dataclass(frozen=True)
class ModeFile:
    """Everything in a mode file (the paper's listing 5)."""

    name: str = option("", "name of the mode, 'monitorName' in messages; the file's name without")
    monitor: str = option("", "function that it is; told from the name without")
    description: str = option("", "what it watches, for people")
    mappings: Sequence[MappingOptions] = option((), "inputs and outputs")
    arguments: Mapping[str, Any] = option({}, "what the monitor wants to know")
    states: Mapping[str, Expression] = option({}, "fault states by name: conditions over outputs")
    stale_after: float | Literal["never"] | None = option(
        None, "after this long without a message of an input it is stale, or never", unit="s"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        for name in self.states:
            if name in STATES:
                yield "states", f"'{name}' is a state of its own: give the fault another name"
        if isinstance(self.stale_after, float | int) and not 0 < self.stale_after < float("inf"):
            yield "stale_after", "must be above 0, or never"


@dataclass(frozen=True)
class DependencyMonitors:
    """Which monitor says whether a dependency works, by dependency; ``none`` for nobody."""

    heartbeat: Mapping[str, str] = option({}, "COMPONENT/MODE that says whether it is alive")
    functional: Mapping[str, str] = option({}, "COMPONENT/MODE that says whether it works")


@dataclass(frozen=True)
class ComponentFile:
    """Everything in a component file (the paper's listing 4)."""

    component_name: str = option(doc="name of the component", aliases=["name"])
    description: str = option("", "what it is, for people")
    modes: Sequence[str] = option((), "mode files, seen from this file, then from components/")
    dependencies: Any = option((), "components that it needs: a list, or {any: [...]} and so on")
    dependency_monitors: DependencyMonitors = option(
        DependencyMonitors(), "which monitor speaks for a dependency"
    )
    recovery_actions: Sequence[str] = option((), "shown, not carried out")
    part_of: str = option("", "component that it is a part of")
    policy: Policy = option("all", "how many of its modes must be ok: all, any or majority")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        if not self.component_name.strip():
            yield "component_name", "must not be empty"


@dataclass(frozen=True)
class RecoveryOptions:
    """One entry of ``recovery_config.yaml``: what the predecessor restarted, and when."""

    monitor: str = option(doc="COMPONENT/MODE that tells the fault")
    monitored_parameter: str = option("", "output of it")
    restart: str = option("", "unit to restart")
    component_type: str = option("", "how it is restarted, such as systemd")
    recover_children: bool = option(False, "whether what depends on it is restarted too")
