"""How busy the processor is, whole or one of its cores."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence

from amberbox.core.errors import UsageError
from amberbox.core.host import ALL_CORES, busy_percent, core_times
from amberbox.core.probe import Measured

MEASURES = {
    "percent": ("float", "%", "busy during one second; 100: all that was asked for is busy"),
    "load_1m": ("float", "", "processes that ran or waited to run, mean of the last minute"),
    "cores": ("int", "", "cores that are switched on"),
}
SUBJECT = "all, or a core such as cpu0"
PERIOD_S = 2.0

_WINDOW_S = 1.0


def measure(subject: str) -> Measured:
    """Measure over one second; ``ok`` means only that it could be measured."""
    before = core_times()
    _core(subject, before)
    time.sleep(_WINDOW_S)
    return judge(subject, before, core_times())


def judge(
    subject: str, before: Mapping[str, Sequence[float]], after: Mapping[str, Sequence[float]]
) -> Measured:
    """Return the measurement from two readings of all cores."""
    return {
        "ok": True,
        "percent": busy_percent(_core(subject, before), _core(subject, after)),
        "load_1m": os.getloadavg()[0],
        "cores": len(after) - 1,
    }


def _core(subject: str, times: Mapping[str, Sequence[float]]) -> Sequence[float]:
    name = ALL_CORES if subject in ("", "all") else subject
    if name not in times:
        known = ", ".join(core for core in times if core != ALL_CORES)
        raise UsageError(f"there is no core '{subject}'", f"known: all, {known}")
    return times[name]
