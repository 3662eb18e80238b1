"""How much memory is in use."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "used_percent": ("float", "%", "what programs cannot get any more"),
    "available_bytes": ("int", "bytes", "what programs can still get"),
}
SUBJECT = "ram, or swap"
PERIOD_S = 2.0

_FIELDS = {"ram": ("MemTotal", "MemAvailable"), "swap": ("SwapTotal", "SwapFree")}


def measure(subject: str) -> Measured:
    """Measure the memory; ``ok`` means only that it could be measured."""
    return read(Path("/proc/meminfo"), subject)


def read(meminfo: Path, subject: str) -> Measured:
    """Read ``/proc/meminfo``."""
    if subject not in _FIELDS:
        raise UsageError(f"there is no memory '{subject}'", "known: ram, swap")
    lines = (line.partition(":") for line in meminfo.read_text().splitlines())
    bytes_of = {name: int(rest.split()[0]) * 1024 for name, _, rest in lines}
    total, available = (bytes_of[field] for field in _FIELDS[subject])
    if not total:
        raise AmberboxError(f"this computer has no {subject}")
    return {
        "ok": True,
        "used_percent": 100 * (total - available) / total,
        "available_bytes": available,
    }
