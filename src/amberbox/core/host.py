"""Readers of this computer's state by psutil, shared by the source ``host`` and the probes.

psutil is imported when something is read. It has no thermal zones beside hwmon, no carriers of
links, no inodes and no file systems that became read-only: these are read from the kernel.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from amberbox.core.errors import AmberboxError

if TYPE_CHECKING:
    import psutil

ALL_CORES = "cpu"
_IDLE, _WAITING = 3, 4  # fields of psutil.cpu_times: idle, waiting for a disk
_COUNTED = 8  # those after it (guests) are part of others
_RUNS_SCRIPTS = ("python*", "perl*", "bash", "sh", "dash", "ruby", "node")
_SHOWN_NAME = 15  # the kernel cuts names of processes here, psutil completes them
_MB = 1e6
_ESCAPED = re.compile(r"\\([0-7]{3})")  # characters of a folder in mountinfo
_UP = 0x1  # IFF_UP


def core_times() -> Mapping[str, Sequence[float]]:
    """Return the seconds that all cores (``cpu``) and each one (``cpu0``) have spent, by kind."""
    import psutil

    each = psutil.cpu_times(percpu=True)
    names = _online_cores(Path("/sys/devices/system/cpu/online"))
    if len(names) != len(each):  # a container shows other cores
        names = [f"cpu{number}" for number in range(len(each))]
    return {ALL_CORES: psutil.cpu_times(), **dict(zip(names, each, strict=True))}


def _online_cores(path: Path) -> list[str]:
    """Read a list such as ``0,2-3``."""
    try:
        bounds = [part.split("-") for part in path.read_text().strip().split(",")]
        return [f"cpu{n}" for part in bounds for n in range(int(part[0]), int(part[-1]) + 1)]
    except (OSError, ValueError):
        return []


def busy_percent(before: Sequence[float], after: Sequence[float]) -> float | None:
    """Return how busy a core was between two readings; None if its counters stood still."""
    spent = [b - a for a, b in zip(before[:_COUNTED], after[:_COUNTED], strict=True)]
    whole = sum(spent)
    idle = spent[_IDLE] + spent[_WAITING]
    return 100 * (whole - idle) / whole if whole > 0 else None


class MemoryUsage(NamedTuple):
    """Memory in bytes; ``available`` is what programs can still get."""

    total: int
    available: int

    @property
    def used_percent(self) -> float | None:
        """Return the part that programs cannot get any more; None if there is no such memory."""
        return 100 * (self.total - self.available) / self.total if self.total else None


def memory(kind: str) -> MemoryUsage:
    """Return the use of ``ram`` or ``swap``."""
    import psutil

    if kind == "ram":
        ram = psutil.virtual_memory()
        return MemoryUsage(ram.total, ram.available)
    swap = psutil.swap_memory()
    return MemoryUsage(swap.total, swap.free)


class ProcessUsage(NamedTuple):
    """The usage of a process: processor time so far, memory and threads now."""

    cpu_s: float
    rss_mb: float
    threads: int = 1


@dataclass(frozen=True, slots=True)
class RunningProcess:
    """A process and what it is known by."""

    process: psutil.Process
    command: str
    names: frozenset[str]

    def is_called(self, subject: str) -> bool:
        """Return whether a program, script or pattern of a command line means this process."""
        if "*" in subject:
            return fnmatchcase(self.command, subject)
        return subject in self.names


def running_processes() -> tuple[list[RunningProcess], bool]:
    """Return the processes that can be seen, without our own, and whether others are hidden."""
    import psutil

    own, seen, is_hidden, has_first = os.getpid(), [], False, False
    for process in psutil.process_iter():
        has_first = has_first or process.pid == 1
        if process.pid == own:
            continue
        try:
            words, name = process.cmdline(), process.name()
        except psutil.NoSuchProcess:
            continue
        except psutil.AccessDenied:
            is_hidden = True
            continue
        names = frozenset((*_names(words), name, name[:_SHOWN_NAME]))
        seen.append(RunningProcess(process, " ".join(words), names))
    return seen, is_hidden or not has_first


def find_processes(subject: str) -> list[psutil.Process]:
    """Return the processes of a program, script or pattern of a command line, without our own.

    Raises PermissionError when none is found where others' processes are hidden.
    """
    seen, is_hidden = running_processes()
    found = [running.process for running in seen if running.is_called(subject)]
    if not found and is_hidden:
        raise PermissionError("processes of other users are hidden (hidepid)")
    return found


def usage(processes: Iterable[psutil.Process]) -> dict[int, ProcessUsage]:
    """Read what processes have used, by their ids; those that have ended are left out."""
    import psutil

    found = {}
    for process in processes:
        with suppress(psutil.NoSuchProcess), process.oneshot():
            if process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
                times = process.cpu_times()
                rss_mb = process.memory_info().rss / _MB
                seconds = times.user + times.system
                found[process.pid] = ProcessUsage(seconds, rss_mb, process.num_threads())
    return found


def _names(words: list[str]) -> Iterator[str]:
    """Yield the names of a process: that of its program, and of the script it runs."""
    program = PurePosixPath(words[0]).name if words else ""
    yield program
    if any(fnmatchcase(program, runner) for runner in _RUNS_SCRIPTS):
        scripts = (PurePosixPath(word).name for word in words[1:] if not word.startswith("-"))
        yield from islice(scripts, 1)


class FileSystemMount(NamedTuple):
    """Where a file system is mounted, and whether it is read-only itself.

    A service may see a disk through a mount that is read-only for it alone, which does not count.
    """

    point: Path
    read_only: bool


class DiskUsage(NamedTuple):
    """How full a disk is; percentages as df counts them, None where there is no limit."""

    total_bytes: int
    free_bytes: int
    used_percent: float | None
    inodes_percent: float | None
    read_only: bool
    mount: str


def disk_usage(path: Path) -> DiskUsage:
    """Return the use of the disk that a path lies on; raises OSError or AmberboxError."""
    found = os.statvfs(path)
    mounts = Path("/proc/self/mountinfo").read_text(errors="replace")
    return usage_of_disk(found, mount_of(path.resolve(), mounts))


def usage_of_disk(found: os.statvfs_result, mount: FileSystemMount) -> DiskUsage:
    """Return the use of a disk from the statistics of its file system."""
    if not found.f_blocks:
        raise AmberboxError("there is no disk behind it")
    used = found.f_blocks - found.f_bfree
    return DiskUsage(
        total_bytes=found.f_blocks * found.f_frsize,
        free_bytes=found.f_bavail * found.f_frsize,
        used_percent=_percent(used, used + found.f_bavail),
        inodes_percent=_percent(found.f_files - found.f_ffree, found.f_files),
        read_only=mount.read_only,
        mount=str(mount.point),
    )


def mount_of(path: Path, mountinfo: str) -> FileSystemMount:
    """Find the mount that a path lies on in ``/proc/self/mountinfo``; of equals the last one."""
    mounts = [_mount(line) for line in mountinfo.splitlines()]
    above = [mount for mount in mounts if path.is_relative_to(mount.point)]
    if not above:
        raise AmberboxError(f"nothing is mounted at {path}")
    return max(reversed(above), key=lambda mount: len(mount.point.parts))


def _mount(line: str) -> FileSystemMount:
    fields, _, of_file_system = line.partition(" - ")
    point = _ESCAPED.sub(lambda code: chr(int(code[1], 8)), fields.split()[4])
    return FileSystemMount(Path(point), "ro" in of_file_system.split()[-1].split(","))


def _percent(part: int, whole: int) -> float | None:
    return 100 * part / whole if whole else None


class LinkState(NamedTuple):
    """The state of a network interface, as the kernel names it; speed None if it is not told."""

    state: str
    is_up: bool
    carrier: bool
    speed_mbit: int | None


def link_state(place: Path) -> LinkState:
    """Read the folder of an interface in ``/sys/class/net``."""
    is_up = bool(int((place / "flags").read_text(), 16) & _UP)
    speed = number_in(place / "speed")
    return LinkState(
        state=_text(place / "operstate"),
        is_up=is_up,
        carrier=is_up and number_in(place / "carrier") == 1,
        speed_mbit=speed if speed is not None and speed > 0 else None,
    )


def number_in(path: Path) -> int | None:
    """Read a number that drivers may refuse (an interface that is down has no speed)."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


class TemperatureSensor(NamedTuple):
    """One temperature, and its critical value (None if not known)."""

    name: str
    celsius: float
    critical: float | None


def temperatures(root: Path = Path("/sys/class")) -> Iterator[TemperatureSensor]:
    """Read every thermal zone and hwmon sensor; unreadable ones are left out."""
    for zone in sorted(root.glob("thermal/thermal_zone*")):
        with suppress(OSError, ValueError):
            yield TemperatureSensor(
                _text(zone / "type"), _celsius(zone / "temp"), _zone_critical(zone)
            )
    for file in sorted(root.glob("hwmon/hwmon*/temp*_input")):
        with suppress(OSError, ValueError):
            yield _hwmon(file)


def _hwmon(file: Path) -> TemperatureSensor:
    stem = file.name.removesuffix("_input")
    label, critical = file.with_name(f"{stem}_label"), file.with_name(f"{stem}_crit")
    part = _text(label) if label.exists() else stem
    limit = _celsius(critical) if critical.exists() else None
    return TemperatureSensor(
        f"{_text(file.parent / 'name')}/{part}", _celsius(file), _plausible(limit)
    )


def _zone_critical(zone: Path) -> float | None:
    for kind in sorted(zone.glob("trip_point_*_type")):
        if _text(kind) == "critical":
            limit = _celsius(kind.with_name(kind.name.replace("_type", "_temp")))
            return _plausible(limit)
    return None


def _plausible(limit: float | None) -> float | None:
    """Drop limits that drivers use for 'none' (0, -273, 65261 degrees)."""
    return limit if limit is not None and 0 < limit < 1000 else None


def _text(path: Path) -> str:
    return path.read_text(errors="replace").strip()


def _celsius(path: Path) -> float:
    return int(_text(path)) / 1000
