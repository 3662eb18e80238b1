"""Processes that others have started: all of them found and ended, also those that broke away.

The caller is their subreaper (``adopt_orphans``): a process whose parent dies becomes its child, so
that nothing below it gets lost, whatever sessions it makes.
"""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

_PR_SET_CHILD_SUBREAPER = 36
_AFTER_COMMAND = 2  # in /proc/PID/stat, behind the name in parentheses: state, parent
_LOOK_S = 0.005
_GONE_S = 5.0


def adopt_orphans() -> None:
    """Make this process the parent of orphans below it."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def descendants(spared: Collection[int] = ()) -> list[int]:
    """Return the ids of all processes below this one, except those spared and those below them."""
    children: dict[int, list[int]] = {}
    for pid, parent in _parents():
        children.setdefault(parent, []).append(pid)
    found, waiting = [], [os.getpid()]
    while waiting:
        below = [pid for pid in children.get(waiting.pop(), ()) if pid not in spared]
        found += below
        waiting += below
    return found


def _parents() -> Iterator[tuple[int, int]]:
    for place in Path("/proc").iterdir():
        if place.name.isdigit():
            with suppress(OSError, ValueError, IndexError):
                text = (place / "stat").read_text(errors="replace")
                yield int(place.name), int(text.rpartition(")")[2].split()[_AFTER_COMMAND - 1])


def end_descendants(spared: Collection[int] = ()) -> bool:
    """Kill and reap every process below this one; return whether all are gone.

    What multiplies has to be killed as a group before: a group goes at once.
    """
    end_s = time.monotonic() + _GONE_S
    while left := descendants(spared):
        for pid in left:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
        if time.monotonic() > end_s:
            return False
        time.sleep(_LOOK_S)
    return True
