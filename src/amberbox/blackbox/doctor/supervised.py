"""Does somebody look after the recorder and the watcher, and had to start them again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from amberbox.blackbox.doctor.finding import Finding, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.store import Store, is_locked

STATE_FILE = "run.json"
"""What ``amberbox run`` writes into the store: how its processes are."""
LOCK = "run"
"""The lock that it holds."""
_UP = frozenset({"running", "starting", "stopping", "off"})


def supervisor(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say how the processes are that ``amberbox run`` looks after; nothing where it does not."""
    store = subject.store
    if store is not None and is_locked(store, LOCK):
        yield judged_supervisor(_state(store), f"amberbox events {subject.path}")


def judged_supervisor(state: Mapping[str, Any], hint: str) -> Finding:
    """Judge the processes as their supervisor states them."""
    children: Mapping[str, Mapping[str, Any]] = state.get("children", {})
    found = f"amberbox run (process {state.get('pid', 'unknown')}) looks after " + ", ".join(
        _one(name, child) for name, child in children.items() if child["state"] != "off"
    )
    bad = [child for child in children.values() if child["state"] not in _UP or child["restarts"]]
    return warn("supervisor", found, hint) if bad else ok("supervisor", found)


def _one(name: str, child: Mapping[str, Any]) -> str:
    again = f", started again {child['restarts']} times" if child["restarts"] else ""
    trouble = f": {child['trouble']}" if child["trouble"] else ""
    return f"{name} ({child['state']}{again}{trouble})"


def _state(store: Store) -> Mapping[str, Any]:
    try:
        state: Mapping[str, Any] = json.loads((store.path / STATE_FILE).read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return state
