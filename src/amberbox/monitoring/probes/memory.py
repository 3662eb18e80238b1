"""How much memory is in use."""

from __future__ import annotations

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.host import memory
from amberbox.core.probe import Measured

MEASURES = {
    "used_percent": ("float", "%", "what programs cannot get any more"),
    "available_bytes": ("int", "bytes", "what programs can still get"),
}
SUBJECT = "ram, or swap"
PERIOD_S = 2.0


def measure(subject: str) -> Measured:
    """Measure the memory; ``ok`` means only that it could be measured."""
    if subject not in ("ram", "swap"):
        raise UsageError(f"there is no memory '{subject}'", "known: ram, swap")
    found = memory(subject)
    if not found.total:
        raise AmberboxError(f"this computer has no {subject}")
    return {
        "ok": True,
        "used_percent": found.used_percent,
        "available_bytes": found.available,
    }
