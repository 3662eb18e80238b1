"""Check the processes: is it recording, supervised, and started after a reboot."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from amberbox.agent.doctor.subject import (
    DoctorFinding,
    ExaminedRobot,
    HostSystem,
    error,
    in_time,
    ok,
    read_state,
    warn,
)
from amberbox.agent.systemd_unit import UNITS, argument
from amberbox.blackbox.journal.scan import late_ns_of, start_record
from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.retention.usage import FULL, RESERVE
from amberbox.blackbox.robot_folder.robot_yaml import read_key
from amberbox.blackbox.store.store import Store, is_locked
from amberbox.core.clock import NS

_PATIENCE_S = 2.0
_AGAIN_S = 0.02


def recorder(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check that the store is being written, and the age of the newest record."""
    store = subject.store
    if store is None:
        yield warn("recorder", "nothing has been recorded yet", f"amberbox record {subject.path}")
        return
    head = _newest_head(store)
    late_s = max(_PATIENCE_S, 20 * subject.options.write_s) + _held_back_s(store, head)
    found = judged_recorder(writer_pid(store), head, host.clock.wall_ns(), late_s, subject.path)
    why = why_only_events(store, subject.options.reserve)
    if why and found.level == "ok":
        hint = "amberbox events tells since when; make room, raise store.quota or lower keep_min"
        found = error("recorder", f"{found.found}, but only events are recorded: {why}", hint)
    yield found


def _held_back_s(store: Store, head: JournalHead | None) -> float:
    """Return how long messages that come late may hold the watermark back, in seconds."""
    if head is None or not head.file:
        return 0.0
    with suppress(OSError):
        return late_ns_of(start_record(store.folder("main") / head.file)) / NS
    return 0.0


def _newest_head(store: Store) -> JournalHead | None:
    """Return the head, retrying while it is missing or torn because the recorder just began; or
    None.
    """
    until_s = time.monotonic() + _PATIENCE_S
    while (head := read_head(store.folder("main"))) is None:
        if not is_locked(store, "main") or time.monotonic() >= until_s:
            return None
        time.sleep(_AGAIN_S)
    return head


def why_only_events(store: Store, reserve: int) -> str:
    """Return why a store takes events only; empty while it takes everything."""
    with suppress(OSError):
        return (store.path / FULL).read_text(errors="replace").strip() or "store is full"
    with suppress(OSError):
        if reserve and not (store.path / RESERVE).stat().st_size:
            return "disk full"
    return ""


def judged_recorder(
    pid: int | None, head: JournalHead | None, now_ns: int, late_s: float, folder: Path
) -> DoctorFinding:
    """Check the recorder by its process and the head of its journal."""
    age_s = (now_ns - head.watermark_ns) / NS if head and head.watermark_ns else None
    last = f"last write {in_time(max(0.0, age_s))} ago" if age_s is not None else "no last write"
    if pid is None:
        return warn("recorder", f"not running, {last}", f"amberbox record {folder}")
    if head is not None and head.watermark_ns == 0:
        hint = "amberbox events names the reason; make room on the disk, or replace it"
        return error("recorder", f"runs (process {pid}), but the disk does not take data", hint)
    if head is None or age_s is None or age_s > late_s:
        hint = "as a service it is killed and started again; otherwise do that yourself"
        return error("recorder", f"process {pid} hangs: {last}", hint)
    waiting = head.next_seq - head.durable_seq
    return ok("recorder", f"runs (process {pid}), {last}, {waiting} records not yet synced")


def writer_pid(store: Store) -> int | None:
    """Return the id of the process that records into the store; None without one."""
    if not is_locked(store, "main"):
        return None
    text = (store.path / "lock.main").read_text().strip()
    return int(text) if text.isdecimal() else 0


@dataclass(frozen=True, slots=True)
class SystemdUnit:
    """A unit of systemd that records this folder."""

    name: str
    enabled: bool
    watchdog: str


def service(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check that the recorder starts with the computer and has a watchdog."""
    unit = find_unit(subject.path, host)
    pid = writer_pid(subject.store) if subject.store else None
    group = host.text(f"/proc/{pid}/cgroup") if pid else ""
    yield judged_service(unit, pid, group, subject.path)


def find_unit(folder: Path, host: HostSystem) -> SystemdUnit | None:
    """Find the installed unit whose command records a folder."""
    units = host.path(UNITS)
    wanted = argument(folder.resolve()).replace("$", "$$")
    for path in sorted(units.glob("*.service")):
        text = host.text(f"{UNITS}/{path.name}")
        command = re.search(r"^ExecStart=.*amberbox.* (?:record|run)(.*)$", text, re.M)
        if command and command[1].endswith(f" {wanted}"):
            watchdog = re.search(r"^WatchdogSec=(\S+)", text, re.M)
            enabled = any(units.glob(f"*.wants/{path.name}"))
            return SystemdUnit(path.name, enabled, watchdog[1] if watchdog else "")
    return None


def judged_service(
    unit: SystemdUnit | None, pid: int | None, group: str, folder: Path
) -> DoctorFinding:
    """Check the systemd unit and the running process; ``group`` is the process's control group."""
    if unit is None:
        hint = f"amberbox install-service {folder} shows what it would set up"
        return warn("service", "not installed: after a start or a crash nobody records", hint)
    if not unit.enabled:
        hint = f"systemctl enable --now {unit.name}"
        return warn("service", f"{unit.name} is installed, but does not start by itself", hint)
    if not unit.watchdog:
        hint = "install it anew: amberbox install-service"
        return warn("service", f"{unit.name} has no watchdog: one that hangs stays so", hint)
    found = f"{unit.name} starts by itself, watchdog {unit.watchdog} s"
    if pid is None:
        return warn("service", f"{found}, but is not active", f"systemctl status {unit.name}")
    if unit.name not in group:
        hint = f"stop process {pid}, then: systemctl start {unit.name}"
        return warn("service", f"{found}, but a recorder started by hand runs", hint)
    return ok("service", f"{found}, active")


SUPERVISOR_STATE_FILE = "run.json"  # store file: state of the children of ``amberbox run``
SUPERVISOR_LOCK = "run"  # its lock
_UP = frozenset({"running", "starting", "stopping", "off"})


def supervisor(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the processes that ``amberbox run`` supervises, while it runs."""
    store = subject.store
    if store is not None and is_locked(store, SUPERVISOR_LOCK):
        yield judged_supervisor(
            read_state(store, SUPERVISOR_STATE_FILE), f"amberbox events {subject.path}"
        )


def judged_supervisor(state: Mapping[str, Any], hint: str) -> DoctorFinding:
    """Check the processes by the state that their supervisor wrote."""
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


LINK_STATE_FILE = "link-state.json"  # file in the store with the state of ``amberbox link``
LINK_LOCK = "link"  # its lock
_OLD_NS = 60 * NS


def link(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the link to the server, if the folder names one."""
    folder = subject.folder
    if folder is None or folder.robot.server is None:
        return
    if not read_key(folder.path, folder.robot.server):
        hint = f"amberbox join {subject.path} LINE, with the line that the server gave"
        yield warn("link", "there is no key to the server, so nothing is sent", hint)
    elif subject.store is None or not is_locked(subject.store, LINK_LOCK):
        hint = f"amberbox run {subject.path} keeps it linked"
        yield warn("link", f"nothing links this robot to {folder.robot.server.url} now", hint)
    else:
        yield judged_link(
            read_state(subject.store, LINK_STATE_FILE),
            time.time_ns(),
            f"amberbox events {subject.path}",
        )


def judged_link(state: Mapping[str, Any], now_ns: int, hint: str) -> DoctorFinding:
    """Check the link by the state that it wrote."""
    words = link_in_words(state, now_ns)
    is_old = now_ns - int(state.get("at_ns", 0)) > _OLD_NS
    return ok("link", words) if state.get("connected") and not is_old else warn("link", words, hint)


def link_in_words(state: Mapping[str, Any], now_ns: int) -> str:
    """Return a line on the link."""
    server = str(state.get("server", "the server"))
    age_ns = now_ns - int(state.get("at_ns", 0))
    if age_ns > _OLD_NS:
        return f"the link to {server} has said nothing for {in_time(age_ns / NS)}"
    if not state.get("connected"):
        trouble = str(state.get("trouble", ""))
        return f"no link to {server}{f': {trouble}' if trouble else ''}"
    backlog = int(state.get("backlog", 0))
    waits = f", the newest {backlog} records are not acknowledged yet" if backlog else ""
    unknown = int(state.get("unknown_frames", 0))
    ignored = f", {unknown} frames of its newer version were ignored" if unknown else ""
    return f"linked to {server}{waits}{ignored}"


MIRROR_STATE_FILE = "mirror-state.json"  # file in the store with the state of ``amberbox mirror``
MIRROR_LOCK = "mirror"  # its lock


def mirror(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the copying to a database, if the folder names one."""
    options = subject.folder.robot.mongodb if subject.folder is not None else None
    if options is None:
        return
    if find_spec("pymongo") is None:
        yield error("mirror", "lacks pymongo", "pip install 'amberbox[formats]'")
    elif subject.store is None or not is_locked(subject.store, MIRROR_LOCK):
        what = f"nothing copies to {options.host}/{options.database} now"
        yield warn("mirror", what, f"amberbox run {subject.path} keeps it going")
    else:
        state = read_state(subject.store, MIRROR_STATE_FILE)
        yield judged_mirror(state, time.time_ns(), f"amberbox events {subject.path}")


def judged_mirror(state: Mapping[str, Any], now_ns: int, hint: str) -> DoctorFinding:
    """Check the mirror by the state that it wrote."""
    words = mirror_in_words(state, now_ns)
    is_old = now_ns - int(state.get("at_ns", 0)) > _OLD_NS
    is_whole = not (state.get("refused") or state.get("missed"))
    is_fine = state.get("connected") and not is_old and is_whole
    return ok("mirror", words) if is_fine else warn("mirror", words, hint)


def mirror_in_words(state: Mapping[str, Any], now_ns: int) -> str:
    """Return a line on the copies in a database."""
    target = state.get("target", "the database")
    age_ns = now_ns - int(state.get("at_ns", 0))
    if age_ns > _OLD_NS:
        return f"the mirror to {target} has said nothing for {in_time(age_ns / NS)}"
    if not state.get("connected"):
        trouble = str(state.get("trouble", ""))
        return f"no connection to {target}{f': {trouble}' if trouble else ''}"
    reached_ns = int(state.get("mirrored_ns", 0))
    until = f", up to {in_time((now_ns - reached_ns) / NS)} ago" if reached_ns else ""
    refused, missed = int(state.get("refused", 0)), int(state.get("missed", 0))
    bad = f", {refused} documents were refused" if refused else ""
    bad += f", {missed} records were gone before they were copied" if missed else ""
    return f"copies to {target}: {state.get('documents', 0)} documents{until}{bad}"
