"""How busy the processor is, whole or one of its cores."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from amberbox.core.errors import UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "percent": ("float", "%", "busy during one second; 100: all that was asked for is busy"),
    "load_1m": ("float", "", "processes that ran or waited to run, mean of the last minute"),
    "cores": ("int", "", "cores that are switched on"),
}
SUBJECT = "all, or a core such as cpu0"
PERIOD_S = 2.0

_WINDOW_S = 1.0
_IDLE, _WAITING = 3, 4  # columns of /proc/stat: idle, waiting for a disk
_COUNTED = 8  # those after it (guests) are part of others


def measure(subject: str) -> Measured:
    """Measure over one second; ``ok`` means only that it could be measured."""
    stat = Path("/proc/stat")
    before = stat.read_text()
    _core(subject, _times(before))
    time.sleep(_WINDOW_S)
    return judge(subject, before, stat.read_text(), Path("/proc/loadavg").read_text())


def judge(subject: str, before: str, after: str, loadavg: str) -> Measured:
    """Return the measurement from two readings of ``/proc/stat``."""
    first, last = _times(before), _times(after)
    core = _core(subject, first)
    spent = [b - a for a, b in zip(first[core], last[_core(subject, last)], strict=True)]
    idle = spent[_IDLE] + spent[_WAITING]
    whole = sum(spent)
    return {
        "ok": True,
        "percent": 100 * (whole - idle) / whole if whole > 0 else None,
        "load_1m": float(loadavg.split()[0]),
        "cores": len(last) - 1,
    }


def _core(subject: str, times: Mapping[str, Sequence[int]]) -> str:
    name = "cpu" if subject in ("", "all") else subject
    if name not in times:
        known = ", ".join(core for core in times if core != "cpu")
        raise UsageError(f"there is no core '{subject}'", f"known: all, {known}")
    return name


def _times(stat: str) -> dict[str, list[int]]:
    lines = (line.split() for line in stat.splitlines() if line.startswith("cpu"))
    return {name: [int(text) for text in times[:_COUNTED]] for name, *times in lines}
