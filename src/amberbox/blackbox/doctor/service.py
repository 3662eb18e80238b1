"""Does it record right now, when did it last write, and does it come back by itself."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.deletion.limit import FULL, RESERVE
from amberbox.blackbox.doctor.finding import Finding, error, in_time, ok, warn
from amberbox.blackbox.doctor.host import Host
from amberbox.blackbox.doctor.subject import Subject
from amberbox.blackbox.journal.head import Head, read_head
from amberbox.blackbox.store import Store, is_locked
from amberbox.blackbox.unitfile import UNITS, argument
from amberbox.core.clock import NS

_PATIENCE_S = 2.0
_AGAIN_S = 0.02


def recorder(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say whether the store is being written, and how old the newest record is."""
    store = subject.store
    if store is None:
        yield warn("recorder", "nothing has been recorded yet", f"amberbox record {subject.path}")
        return
    head = _newest_head(store)
    late_s = max(_PATIENCE_S, 20 * subject.options.write_s)
    found = judged_recorder(writer_pid(store), head, host.clock.wall_ns(), late_s, subject.path)
    why = why_only_events(store, subject.options.reserve)
    if why and found.level == "ok":
        hint = "amberbox events tells since when; make room, raise store.quota or lower keep_min"
        found = error("recorder", f"{found.found}, but only events are recorded: {why}", hint)
    yield found


def _newest_head(store: Store) -> Head | None:
    """Read the head; one that just began has none yet, and one that is being written is torn."""
    until_s = time.monotonic() + _PATIENCE_S
    while (head := read_head(store.folder("main"))) is None:
        if not is_locked(store, "main") or time.monotonic() >= until_s:
            return None
        time.sleep(_AGAIN_S)
    return head


def why_only_events(store: Store, reserve: int) -> str:
    """Say why a store takes events only; empty while it takes everything."""
    with suppress(OSError):
        return (store.path / FULL).read_text(errors="replace").strip() or "store is full"
    with suppress(OSError):
        if reserve and not (store.path / RESERVE).stat().st_size:
            return "disk full"
    return ""


def judged_recorder(
    pid: int | None, head: Head | None, now_ns: int, late_s: float, folder: Path
) -> Finding:
    """Judge the end of the journal as its writer states it."""
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
    """Return the process that holds the store; None if nobody does."""
    if not is_locked(store, "main"):
        return None
    text = (store.path / "lock.main").read_text().strip()
    return int(text) if text.isdecimal() else 0


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of systemd that records this folder."""

    name: str
    enabled: bool
    watchdog: str


def service(subject: Subject, host: Host) -> Iterator[Finding]:
    """Say whether the recorder starts with the computer and is watched."""
    unit = find_unit(subject.path, host)
    pid = writer_pid(subject.store) if subject.store else None
    group = host.text(f"/proc/{pid}/cgroup") if pid else ""
    yield judged_service(unit, pid, group, subject.path)


def find_unit(folder: Path, host: Host) -> Unit | None:
    """Find the installed unit whose command records a folder."""
    units = host.path(UNITS)
    wanted = argument(folder.resolve()).replace("$", "$$")
    for path in sorted(units.glob("*.service")):
        text = host.text(f"{UNITS}/{path.name}")
        command = re.search(r"^ExecStart=.*amberbox.* (?:record|run)(.*)$", text, re.M)
        if command and command[1].endswith(f" {wanted}"):
            watchdog = re.search(r"^WatchdogSec=(\S+)", text, re.M)
            enabled = any(units.glob(f"*.wants/{path.name}"))
            return Unit(path.name, enabled, watchdog[1] if watchdog else "")
    return None


def judged_service(unit: Unit | None, pid: int | None, group: str, folder: Path) -> Finding:
    """Judge unit and running process; ``group`` is the process' control group."""
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
