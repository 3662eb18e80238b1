"""Whether an input still says anything: a value that is too old is none, however good it looks."""

from __future__ import annotations

from typing import Any

import numpy as np

from amberbox.core.flow import Flow
from amberbox.core.mode import Input
from amberbox.core.types import IntArray
from amberbox.monitoring.engine.findings import What

FRESH, NO_VALUE, NEVER, OLD, LOST = 0, 1, 2, 3, 4
"""From good to bad: of several inputs the worst counts."""


def flow_codes(flow: Flow, stale_s: float | None, instants: IntArray) -> Any:
    """Tell at each instant whether messages of an item still come."""
    ages = flow.age_s(instants)
    codes = np.where(np.isinf(ages), NEVER, FRESH)
    if stale_s is not None:
        codes = np.where(np.isfinite(ages) & (ages > stale_s), OLD, codes)
    if len(flow.gap_from_ns):
        codes = np.where(flow.lost(instants) & np.isfinite(ages), LOST, codes)
    return codes


def value_codes(entry: Input, instants: IntArray) -> Any:
    """Tell where a variable has a value; None where it has one at all instants."""
    samples = entry.samples
    if samples.null is None and len(samples) and samples.times_ns[0] <= instants[0]:
        return None
    return np.where(samples.known(instants), FRESH, NO_VALUE)


def reason(code: int, entry: Input, stale_s: float | None, at_ns: int) -> tuple[What, str]:
    """Say what an input that is not fresh makes of an output, and why."""
    if code == OLD and _is_own_probe(entry):
        return "unknown", f"nobody has looked at {entry.name} for {stale_s:g} s"
    if code == OLD:
        return "stale", f"nothing received of {entry.name} for {stale_s:g} s"
    if code == LOST:
        why = entry.flow.reasons.get(int(entry.flow.gap_from_ns.at(at_ns)), "")
        return "stale", f"the publisher of {entry.name} is lost" + (f": {why}" if why else "")
    if code == NEVER:
        return "unknown", f"nothing received yet of {entry.name}"
    told = _told(entry, at_ns)
    return "unknown", f"{entry.name}: {told}" if told else f"{entry.name} has no value"


def _is_own_probe(entry: Input) -> bool:
    """Tell whether the watcher itself measures it, as no recorder counts its rows.

    Where it is silent, the watcher was dead: that is nobody's fault.
    """
    return "ok" in entry.parts and not len(entry.flow.received)


def _told(entry: Input, at_ns: int) -> str:
    """Return why a probe could not measure."""
    errors = entry.parts.get("error")
    if errors is None or not len(errors) or not errors.known(at_ns):
        return ""
    return str(errors.at(at_ns))
