"""Is there a link to the server, and what waits for it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from typing import Any

from amberbox.blackbox.doctor.finding import Finding, in_time, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.folder.server import read_key
from amberbox.blackbox.store import Store, is_locked
from amberbox.core.clock import NS

STATE_FILE = "link-state.json"
"""What ``amberbox link`` writes into the store: how it is doing now."""
LOCK = "link"
"""The lock that it holds."""
_OLD_NS = 60 * NS


def link(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say how the link to the server is; nothing where the folder names none."""
    folder = subject.folder
    if folder is None or folder.robot.server is None:
        return
    if not read_key(folder.path, folder.robot.server):
        hint = f"amberbox join {subject.path} LINE, with the line that the server gave"
        yield warn("link", "there is no key to the server, so nothing is sent", hint)
    elif subject.store is None or not is_locked(subject.store, LOCK):
        hint = f"amberbox run {subject.path} keeps it linked"
        yield warn("link", f"nothing links this robot to {folder.robot.server.url} now", hint)
    else:
        yield judged_link(
            link_state(subject.store), time.time_ns(), f"amberbox events {subject.path}"
        )


def judged_link(state: Mapping[str, Any], now_ns: int, hint: str) -> Finding:
    """Judge the link as its process states it."""
    words = link_in_words(state, now_ns)
    is_old = now_ns - int(state.get("at_ns", 0)) > _OLD_NS
    return ok("link", words) if state.get("connected") and not is_old else warn("link", words, hint)


def link_in_words(state: Mapping[str, Any], now_ns: int) -> str:
    """Say in a line how the link is."""
    server = str(state.get("server", "the server"))
    age_ns = now_ns - int(state.get("at_ns", 0))
    if age_ns > _OLD_NS:
        return f"the link to {server} has said nothing for {in_time(age_ns / NS)}"
    if not state.get("connected"):
        trouble = str(state.get("trouble", ""))
        return f"no link to {server}{f': {trouble}' if trouble else ''}"
    backlog = int(state.get("backlog", 0))
    waits = f", the newest {backlog} records are not acknowledged yet" if backlog else ""
    return f"linked to {server}{waits}"


def link_state(store: Store) -> Mapping[str, Any]:
    """Read what the link wrote down last; empty if it has not yet."""
    try:
        state: Mapping[str, Any] = json.loads((store.path / STATE_FILE).read_text())
    except (OSError, ValueError):
        return {}
    return state
