"""Symptoms by statuses alone: where a watcher told of no symptoms, or what it told is not here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from amberbox.core.types import Output, Status, Symptom, SymptomState
from amberbox.monitoring.engine.judging import holds
from amberbox.monitoring.engine.symptoms import measured_from
from amberbox.monitoring.plan import Expectation, ModePlan, Plan

SOURCE = "monitor"


def symptoms_of(plan: Plan, statuses: Iterable[Status]) -> Iterator[Symptom]:
    """Yield what each output of a mode says, as it is expected by a robot's component files.

    A mode that is stale or not initialised, or waits for another one, says nothing for certain.
    """
    modes = {(component.id, mode.id): mode for component, mode in plan.modes()}
    for status in statuses:
        mode = modes.get((status.component, status.mode))
        if mode is not None:
            yield from _of_mode(mode, status)


def _of_mode(mode: ModePlan, status: Status) -> Iterator[Symptom]:
    outputs = ((mapping, output) for mapping in mode.mappings for output in mapping.outputs)
    for mapping, output in outputs:
        if output.expectation.value is None:
            continue
        address = f"{status.component}/{mode.id}/{output.name}"
        state = _state(output.expectation, status.outputs.get(output.name), status)
        onset_ns = status.since_ns if state == "present" else None
        evidence = (
            ()
            if onset_ns is None
            else tuple(
                (name, onset_ns, status.measured_ns) for name in measured_from(mapping, output)
            )
        )
        yield Symptom(
            address, state, address, onset_ns, status.measured_ns, source=SOURCE,
            evidence=evidence, blocked_by=status.blocked_by,
        )  # fmt: skip


def _state(expected: Expectation, value: Output, status: Status) -> SymptomState:
    """Judge a value; a fault that has not lasted long enough does not show in the level yet."""
    if value is None or status.level in ("stale", "unknown"):
        return "unknown"
    try:
        is_good = bool(holds(expected, value))
    except TypeError:
        return "unknown"  # it was of another type then
    return "absent" if is_good or status.level == "ok" else "present"
