"""The watcher's sign of life in a small file: that it runs, and how late it evaluates.

It is apart from the statuses and does not wait for them, so that who reads it can tell a watcher
that is late from one that hangs, and from a robot that is not watched.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from typing import NamedTuple

from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.robotstatus import Monitoring

WATCH = "watch"
"""The lock that a watcher holds."""
STATE_FILE = "watch-state.json"
OVERLOADED_S = 3.0
"""Monitoring that evaluates rows later than this after they were written is overloaded."""
SILENT_S = 5.0
"""A watcher gives a sign of life each second; one that is older than this says nothing."""


class Pulse(NamedTuple):
    """How the monitoring of a robot is doing.

    ``delay_s`` is how late rows are evaluated; of a silent watcher, the age of its sign of life.
    """

    state: Monitoring = "absent"
    delay_s: float = 0.0


def write_pulse(store: Store, clock: Clock, delay_s: float) -> None:
    """Write that this process watches now, and how late; the file need not survive anything."""
    values = {
        "pid": os.getpid(), "boot_id": clock.boot_id(), "boot_ns": clock.boot_ns(),
        "delay_s": round(delay_s, 3),
    }  # fmt: skip
    part = store.path / f"{STATE_FILE}.part"
    with suppress(OSError):  # a full disk: its age is shown
        part.write_text(json.dumps(values))
        part.replace(store.path / STATE_FILE)


def monitoring_of(store: Store, clock: Clock | None = None) -> Pulse:
    """Return how a store's watcher is doing.

    One that writes no sign of life (an older version, or one that has just begun) is running.
    """
    if not is_locked(store, WATCH):
        return Pulse()
    clock = clock or SystemClock()
    try:
        values = json.loads((store.path / STATE_FILE).read_text())
        is_of_now = values["boot_id"] == clock.boot_id() and _is_alive(int(values["pid"]))
        age_s = (clock.boot_ns() - int(values["boot_ns"])) / NS
        delay_s = float(values["delay_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return Pulse("running")
    if not is_of_now:
        return Pulse("running")
    if age_s > SILENT_S:
        return Pulse("silent", age_s)
    return Pulse("overloaded" if delay_s > OVERLOADED_S else "running", delay_s)


def _is_alive(pid: int) -> bool:
    """Tell whether there is such a process: else the file is that of a watcher before."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
