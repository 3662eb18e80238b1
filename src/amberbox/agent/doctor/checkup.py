"""Run all checks of the doctor, and those of the computer: clock, power, packages, keys, folder."""

from __future__ import annotations

import importlib.util
import platform
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeAlias

from amberbox.agent.doctor.disk import file_system, latency, root, space, wear
from amberbox.agent.doctor.processes import link, mirror, recorder, service, supervisor
from amberbox.agent.doctor.subject import (
    DoctorFinding,
    ExaminedRobot,
    HostSystem,
    error,
    ok,
    subject,
    warn,
)
from amberbox.blackbox.robot_folder.black_box_yaml import SourceBlock
from amberbox.blackbox.robot_folder.folder import SOURCES
from amberbox.core.errors import AmberboxError
from amberbox.core.files import open_to_all
from amberbox.core.plugins import Plugin, get, install_hint, missing_packages
from amberbox.core.version import __version__

# programs that set the clock, by process name
DAEMONS = {
    "chronyd": "chrony",
    "ntpd": "ntpd",
    "systemd-timesyn": "systemd-timesyncd",
    "ptp4l": "PTP",
    "phc2sys": "PTP",
}


def clock(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check that wall time is synchronised; order and durations do not depend on it."""
    daemon = next((DAEMONS[name] for name in host.processes() if name in DAEMONS), "")
    yield judged_clock(host.clock.synchronised(), daemon)


def judged_clock(synchronised: bool | None, daemon: str) -> DoctorFinding:
    """Judge the kernel's synchronisation state and the running time daemon."""
    if synchronised:
        return ok("clock", f"synchronised ({daemon or 'by a program that is not known here'})")
    hint = "the record can be compared with other clocks only once this one is set"
    if not daemon:
        hint = f"install chrony or switch on systemd-timesyncd; {hint}"
        return warn("clock", "nobody sets it: no chrony, ntpd, timesyncd or PTP runs", hint)
    if synchronised is None:
        return warn("clock", f"{daemon} runs; the kernel does not say whether it is in step", hint)
    return warn("clock", f"{daemon} runs, but the clock is not synchronised (yet)", hint)


def rtc(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check for a real-time clock, which gives the time at boot without a network."""
    if host.has("/sys/class/rtc/rtc0"):
        yield ok("real-time clock", "there is one (/dev/rtc0)")
        return
    hint = "order and durations stay right; for right dates from the first second add an RTC"
    yield warn("real-time clock", "none: each start begins in the past until the net is up", hint)


_SUPPLIES = "/sys/class/power_supply"


def power(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check whether a source monitors the power supply."""
    blocks = subject.folder.blocks if subject.folder else ()
    watching = [block.name for block in blocks if block.plugin == "power"]
    known = sorted(path.name for path in host.path(_SUPPLIES).glob("*"))
    yield judged_power(watching, known)


def judged_power(watching: list[str], known: list[str]) -> DoctorFinding:
    """Judge the blocks that monitor power, and the supplies that the kernel knows."""
    if watching:
        return ok("power", f"watched by {', '.join(watching)}")
    if known:
        hint = "add '- power:' to black_box.yaml: the kernel knows " + ", ".join(known)
    else:
        hint = "with a supply of its own and '- power:' the box sees and survives a power cut"
    hint += " (docs/robot/appliance.md)"
    return warn("power", "not watched: power is lost without a word", hint)


# package: the extra that installs it, and what is missing without
OPTIONAL = {
    "cryptography": ("keep", "what is recorded is not signed"),
    "pyarrow": ("keep", "no segments are built: queries read journals, slower; no Parquet"),
    "duckdb": ("query", "no SQL"),
    "tsdownsample": ("query", "plots of long ranges are slower"),
    "matplotlib": ("plot", "no plots as images"),
}
_NEEDED = ("cryptography", "pyarrow")

_Find = Callable[[str], object]


def versions(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Report the versions, without importing packages."""
    yield ok("versions", _text())
    yield from judged_packages(importlib.util.find_spec)


def judged_packages(find: _Find) -> Iterator[DoctorFinding]:
    """Report the optional packages that ``find`` does not find."""
    missing = [name for name in OPTIONAL if find(name) is None]
    if not missing:
        return
    found = "; ".join(f"without {name}: {OPTIONAL[name][1]}" for name in missing)
    extras = ",".join(sorted({OPTIONAL[name][0] for name in missing}))
    hint = f"pip install 'amberbox[{extras}]'"
    needed = any(name in _NEEDED for name in missing)
    yield (warn if needed else ok)("packages", found, hint)


def _text() -> str:
    packages = [f"{name} {_version(name)}" for name in ("numpy", *_NEEDED) if _version(name)]
    python = f"Python {platform.python_version()} ({platform.machine()})"
    return ", ".join((f"amberbox {__version__}", python, *packages))


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


_BACKUP = "keep a copy of key.pub off the robot: amberbox verify needs it to prove anything"


def keys(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check the files of the key; the key itself is not read."""
    if subject.store is None:
        yield ok("keys", "none yet: they are made at the first start of the recorder")
        return
    yield _judged(subject)
    what = open_to_all(subject.store_path)
    if what:
        yield warn("store", what, f"chmod -R o-rwx {subject.store_path}")


def _judged(subject: ExaminedRobot) -> DoctorFinding:
    private, public = subject.store_path / "key", subject.store_path / "key.pub"
    if not private.exists():
        what = "only key.pub is there" if public.exists() else "there are none"
        hint = "start the recorder with the package cryptography installed (amberbox[keep])"
        return warn("keys", f"{what}: what is recorded is not signed", hint)
    status = private.stat()
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        hint = f"chmod 600 {private}; if others could read it, delete both to get new ones"
        return error("keys", f"the private key is open to others (mode {mode:04o})", hint)
    if status.st_uid != subject.store_path.stat().st_uid:
        hint = f"chown it to the user who records: {private}"
        return error("keys", "the private key belongs to somebody else than the store", hint)
    if not public.exists():
        hint = "it is made anew from the private key at the next start of the recorder"
        return warn("keys", "key.pub is missing", hint)
    return ok("keys", f"key is private (mode {mode:04o}), key.pub is there", _BACKUP)


def configuration(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Summarise the result of ``amberbox check``."""
    errors = [problem for problem in subject.problems if problem.is_error]
    notes = len(subject.problems) - len(errors)
    if errors:
        more = f" and {len(errors) - 1} more" if len(errors) > 1 else ""
        found = f"{errors[0].file}:{errors[0].line}: {errors[0].what}{more}"
        yield error("configuration", found, f"amberbox check {subject.path} names everything")
        return
    assert subject.folder is not None, "a folder without errors has been read"
    names = ", ".join(block.name for block in subject.folder.blocks)
    if not names:
        yield error("configuration", "black_box.yaml names no source that can be recorded",
                    "amberbox plugins lists the sources")  # fmt: skip
        return
    remark = f"; {notes} note{'s' * (notes > 1)}: amberbox check {subject.path}" if notes else ""
    yield ok("configuration", f"listens to {names}{remark}")


def passivity(subject: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    """Check of each source that it is passive and that its library is installed."""
    for block in subject.folder.blocks if subject.folder else ():
        yield _passive(block)
        lacking = missing_library(get(SOURCES, block.plugin))
        if lacking is not None:
            yield error(f"source {block.name}", *lacking)


def missing_library(plugin: Plugin) -> tuple[str, str] | None:
    """Return which packages a plugin lacks, and how to install them; None if it has all."""
    missing = missing_packages(plugin)
    hint = install_hint(plugin.name) or f"pip install {' '.join(missing)}"
    return (f"lacks {', '.join(missing)}", hint) if missing else None


def _passive(block: SourceBlock) -> DoctorFinding:
    check = f"source {block.name}"
    passivity: Any = getattr(get(SOURCES, block.plugin).load(), "PASSIVE", "")
    if not passivity:
        hint = "ask its author; a source of Amberbox says so in PASSIVE"
        return warn(check, "does not say why it would not disturb the robot", hint)
    return ok(check, str(passivity).format(config=block.config))


Check: TypeAlias = Callable[[ExaminedRobot, HostSystem], Iterable[DoctorFinding]]

# in the order of the report
CHECKS: Sequence[Check] = (
    *(configuration, passivity, recorder, supervisor, link, mirror, service, power),
    *(clock, rtc, space, file_system, root, wear, latency),
    *(keys, versions),
)


def checkup(path: str | Path, host: HostSystem | None = None) -> list[DoctorFinding]:
    """Return the findings about a robot folder and its computer; changes nothing, opens no device.

    Raises UsageError if there is nothing at ``path``.
    """
    patient, on = subject(path), host or HostSystem()
    return [finding for check in CHECKS for finding in _findings(check, patient, on)]


def _findings(check: Check, patient: ExaminedRobot, host: HostSystem) -> Iterator[DoctorFinding]:
    name = check.__name__.replace("_", " ")
    try:
        yield from check(patient, host)
    except PermissionError as trouble:
        where = trouble.filename or "a file"
        yield warn(name, f"{where} may not be read", "run the doctor as the user who records")
    except (OSError, AmberboxError) as trouble:
        text = trouble.what if isinstance(trouble, AmberboxError) else str(trouble)
        yield warn(name, f"could not be looked at: {text}", "the other checks are not affected")
