"""Whether a program runs, how often, and what it takes of the computer."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from amberbox.core.errors import UsageError
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
_RUNS_SCRIPTS = ("python*", "perl*", "bash", "sh", "dash", "ruby", "node")
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class ProcessUsage(NamedTuple):
    """The usage of a process: processor time so far, and memory now."""

    cpu_s: float
    rss_mb: float


def measure(subject: str) -> Measured:
    """Find the processes twice, to measure their usage in between."""
    proc = Path("/proc")
    pids = find(proc, subject)
    begin_s, before = time.monotonic(), usage(proc, pids)
    if before:
        time.sleep(_WINDOW_S)
    return judge(before, usage(proc, pids), time.monotonic() - begin_s)


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


def find(proc: Path, subject: str) -> list[int]:
    """Return the ids of the processes that are meant, without our own.

    Raises PermissionError when none is found where others' processes are hidden.
    """
    if not subject.strip():
        raise UsageError("no process is named", "such as rosmaster")
    hidden: list[int] = []
    own = os.getpid()
    pids = (int(place.name) for place in proc.iterdir() if place.name.isdecimal())
    found = [pid for pid in pids if pid != own and _is(proc / str(pid), subject, hidden)]
    if not found and (hidden or not (proc / "1").exists()):
        raise PermissionError("processes of other users are hidden (hidepid)")
    return found


def usage(proc: Path, pids: Iterable[int]) -> dict[int, ProcessUsage]:
    """Read what processes have used; those that have ended are left out."""
    found: dict[int, ProcessUsage] = {}
    for pid in pids:
        with suppress(FileNotFoundError, ProcessLookupError):
            stat = (proc / str(pid) / "stat").read_text(errors="replace")
            fields = stat.rpartition(")")[2].split()
            if fields[0] not in "ZX":  # dead, but not yet reaped by its parent
                cpu_s = (int(fields[11]) + int(fields[12])) * _TICK_S
                found[pid] = ProcessUsage(cpu_s, int(fields[21]) * _PAGE_MB)
    return found


def _is(place: Path, subject: str, hidden: list[int]) -> bool:
    try:
        words = (place / "cmdline").read_bytes().rstrip(b"\0").decode(errors="replace").split("\0")
        if "*" in subject:
            return fnmatchcase(" ".join(words), subject)
        return subject in _names(words) or (place / "comm").read_text().rstrip("\n") == subject
    except (FileNotFoundError, ProcessLookupError):
        return False
    except PermissionError:
        hidden.append(int(place.name))
        return False


def _names(words: list[str]) -> Iterator[str]:
    """Yield the names of a process: that of its program, and of the script it runs."""
    program = PurePosixPath(words[0]).name
    yield program
    if any(fnmatchcase(program, runner) for runner in _RUNS_SCRIPTS):
        scripts = (PurePosixPath(word).name for word in words[1:] if not word.startswith("-"))
        yield from islice(scripts, 1)
