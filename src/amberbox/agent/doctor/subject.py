"""The subject of the doctor's checks: computer, robot folder, store, bytes written per day."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from amberbox.blackbox.robot_folder.folder import RobotFolder, inspect_folder, store_of
from amberbox.blackbox.robot_folder.robot_yaml import StoreOptions
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.journal_reader import JournalFile, journal_file
from amberbox.blackbox.store.store import Store, is_store, open_store
from amberbox.core.clock import NS, Clock, SystemClock
from amberbox.core.errors import AmberboxError, Problem

Level = Literal["ok", "warn", "error"]


@dataclass(frozen=True, slots=True)
class DoctorFinding:
    """One line of the doctor's report; ``found`` holds the facts, ``hint`` the next step."""

    check: str
    level: Level
    found: str
    hint: str = ""


def ok(check: str, found: str, hint: str = "") -> DoctorFinding:
    """Return a finding without a problem; a hint names a possible improvement."""
    return DoctorFinding(check, "ok", found, hint)


def warn(check: str, found: str, hint: str) -> DoctorFinding:
    """Return a finding of a risk: it records, but data or hardware may be lost."""
    return DoctorFinding(check, "warn", found, hint)


def error(check: str, found: str, hint: str) -> DoctorFinding:
    """Return a finding of a fault: it does not record, or not everything."""
    return DoctorFinding(check, "error", found, hint)


def in_time(seconds: float) -> str:
    """Format a duration for people."""
    for limit, size, unit in ((120, 1, "s"), (7200, 60, "min"), (172_800, 3600, "h")):
        if seconds < limit:
            return f"{seconds / size:.0f} {unit}"
    days = seconds / 86_400
    return f"{days:,.0f} days" if days < 730 else f"{days / 365:,.0f} years"


@dataclass(frozen=True)
class HostSystem:
    """The root of the system's files (tests use their own), and its clock."""

    root: Path = Path("/")
    clock: Clock = field(default_factory=SystemClock)

    def path(self, path: str | Path) -> Path:
        """Return a system path as seen from the root."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str:
        """Return a small file's text; empty if it cannot be read."""
        try:
            return self.path(path).read_text(errors="replace").strip()
        except OSError:
            return ""

    def has(self, path: str | Path) -> bool:
        """Return whether a path exists."""
        return self.path(path).exists()

    def processes(self) -> Iterator[str]:
        """Yield the names of running programs, cut to 15 characters as the kernel does."""
        for entry in self.path("/proc").glob("[0-9]*/comm"):
            try:
                yield entry.read_text().strip()
            except OSError:  # it has just ended
                continue


MOUNTS = "/proc/self/mountinfo"


@dataclass(frozen=True, slots=True)
class MountPoint:
    """A mounted file system; ``device`` is ``major:minor``."""

    point: str
    device: str
    kind: str
    source: str
    options: frozenset[str]


def mount_of(path: Path, table: str) -> MountPoint | None:
    """Return the mount of a path, from the text of mountinfo; later entries cover earlier ones."""
    best: MountPoint | None = None
    for mount in _mounts(table):
        holds = PurePosixPath(path).is_relative_to(mount.point)
        if holds and (best is None or len(mount.point) >= len(best.point)):
            best = mount
    return best


def _mounts(table: str) -> Iterator[MountPoint]:
    for line in table.splitlines():
        before, separator, after = line.partition(" - ")
        own, rest = before.split(), after.split()
        if separator and len(own) >= 6 and len(rest) >= 2:
            options = {*own[5].split(","), *(rest[2].split(",") if len(rest) > 2 else ())}
            yield MountPoint(_unescaped(own[4]), own[2], rest[0], _unescaped(rest[1]),
                        frozenset(options))  # fmt: skip


def _unescaped(text: str) -> str:
    """Undo the kernel's octal escapes of space, tab, newline and backslash."""
    for code, character in (("040", " "), ("011", "\t"), ("012", "\n"), ("134", "\\")):
        text = text.replace(f"\\{code}", character)
    return text


def disk_of(mount: MountPoint, host: HostSystem) -> Path | None:
    """Return the /sys folder of the disk below a mount; None where there is none."""
    found = host.path(f"/sys/dev/block/{mount.device}")
    if not found.exists():  # btrfs and others have virtual device numbers
        found = host.path(f"/sys/class/block/{PurePosixPath(mount.source).name}")
    if not found.exists():
        return None
    disk = found.resolve()
    while below := sorted(disk.glob("slaves/*")):  # encrypted disks, logical volumes
        disk = below[0].resolve()
    return disk.parent if (disk / "partition").exists() else disk


def read_state(store: Store, name: str) -> Mapping[str, Any]:
    """Return the state that a process wrote to file ``name`` of the store; empty without one."""
    try:
        state: Mapping[str, Any] = json.loads((store.path / name).read_text())
    except (OSError, ValueError):
        return {}
    return state


DAY_S = 86_400
_NEWEST = 10
_ENOUGH_S = 10.0


@dataclass(frozen=True, slots=True)
class Traffic:
    """Bytes per day of recording; ``writers`` is the number of journals in use."""

    journal_bytes: float
    segment_bytes: float
    writers: int
    seconds: float

    @property
    def kept_bytes(self) -> float:
        """Bytes that a day of recording leaves in the store."""
        return self.journal_bytes + self.segment_bytes

    def syncs(self, sync_s: float) -> float:
        """Return how often per day journals are synced."""
        return self.writers * DAY_S / sync_s


def traffic(store: Store) -> Traffic | None:
    """Return the traffic measured from the newest files; None below ten seconds of data."""
    writers = {writer: _newest(store, writer) for writer in store.writers()}
    times = {
        writer: sum(file.end_ns - file.start_ns for file in files) / NS
        for writer, files in writers.items()
    }
    known = {writer: files for writer, files in writers.items() if times[writer] >= _ENOUGH_S}
    if not known:
        return None
    journals = sum(sum(f.bytes for f in files) / times[w] for w, files in known.items())
    return Traffic(journals * DAY_S, _segment_rate(store) * DAY_S, len(known), max(times.values()))


def _newest(store: Store, writer: str) -> list[JournalFile]:
    files = []
    for path in store.journal_files(writer)[-_NEWEST:]:
        try:
            files.append(journal_file(path))
        except FileNotFoundError:  # just deleted by the keeper
            continue
    return [file for file in files if file.rows]


def _segment_rate(store: Store) -> float:
    """Return the bytes of segments per second of journals."""
    known = manifest.read(store.path)
    seconds = sum(j.end_ns - j.start_ns for j in known.journals.values()) / NS
    size = sum(segment.bytes for found in known.segments.values() for segment in found)
    return size / seconds if seconds > 0 else 0.0


@dataclass(frozen=True)
class ExaminedRobot:
    """A robot folder as far as it can be read; ``folder`` is None if it has errors."""

    path: Path
    folder: RobotFolder | None
    problems: Sequence[Problem]
    store_path: Path
    options: StoreOptions

    @cached_property
    def store(self) -> Store | None:
        """The store, if something has been recorded, else None."""
        return open_store(self.store_path) if is_store(self.store_path) else None

    @cached_property
    def traffic(self) -> Traffic | None:
        """The bytes written per day; None if too little is recorded."""
        return traffic(self.store) if self.store else None

    @property
    def ground(self) -> Path:
        """The store, or its nearest existing parent folder, on the same disk."""
        place = self.store_path.resolve()
        return next(path for path in (place, *place.parents) if path.is_dir())


def subject(path: str | Path) -> ExaminedRobot:
    """Read a robot folder; raise UsageError if there is nothing at ``path``."""
    folder, problems = inspect_folder(path)
    place = Path(path) if Path(path).is_dir() else Path(path).parent
    if folder is not None:
        return ExaminedRobot(place, folder, problems, folder.store_path, folder.robot.store)
    return ExaminedRobot(place, None, problems, _store_path(place), StoreOptions())


def _store_path(place: Path) -> Path:
    """Return the path of the store although the configuration has errors."""
    try:
        found = store_of(place)
    except AmberboxError:  # the path is robot.yaml itself
        found = None
    return found or place / StoreOptions().path
