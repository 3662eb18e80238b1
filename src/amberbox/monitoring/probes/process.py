"""Whether a program runs, how often, and what it takes of the computer."""

from __future__ import annotations

import time
from collections.abc import Mapping

from amberbox.core.errors import UsageError
from amberbox.core.host import ProcessUsage, find_processes, usage
from amberbox.core.probe import Measured

MEASURES = {
    "count": ("int", "", "how many such processes run"),
    "cpu_percent": ("float", "%", "processor time of all of them over half a second; 100: a core"),
    "rss_mb": ("float", "MB", "memory that all of them hold"),
}
SUBJECT = (
    "name of the program or script, such as rosmaster, or a pattern with * for the whole "
    "command line, such as *move_base*__name:=planner*"
)
PERIOD_S = 2.0

_WINDOW_S = 0.5


def measure(subject: str) -> Measured:
    """Find the processes twice, to measure their usage in between."""
    if not subject.strip():
        raise UsageError("no process is named", "such as rosmaster")
    processes = find_processes(subject)
    begin_s, before = time.monotonic(), usage(processes)
    if before:
        time.sleep(_WINDOW_S)
    return judge(before, usage(processes), time.monotonic() - begin_s)


def judge(
    before: Mapping[int, ProcessUsage], after: Mapping[int, ProcessUsage], seconds: float
) -> Measured:
    """Return the usage from two readings of the processes; those that ended do not count."""
    cpu_s = sum(now.cpu_s - before[pid].cpu_s for pid, now in after.items() if pid in before)
    return {
        "ok": bool(after),
        "count": len(after),
        "cpu_percent": 100 * cpu_s / seconds if after else None,
        "rss_mb": sum(now.rss_mb for now in after.values()) if after else None,
    }
