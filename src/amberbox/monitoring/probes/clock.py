"""Whether the computer's clock is kept right by a reference (NTP, PTP, GPS)."""

from __future__ import annotations

import ctypes
import os

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.probe import Measured

MEASURES = {
    "offset_ms": ("float", "ms", "what is being corrected just now"),
    "max_error_ms": ("float", "ms", "how wrong it may be at most, as the kernel reckons"),
}
SUBJECT = "system"
PERIOD_S = 2.0

_TIME_ERROR = 5
_UNSYNCHRONISED, _NANOSECONDS = 0x40, 0x2000  # STA_UNSYNC, STA_NANO


class _Timex(ctypes.Structure):
    """The beginning of the kernel's ``struct timex``, with padding for the remaining fields."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("max_error", ctypes.c_long),
        ("estimated_error", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def measure(subject: str) -> Measured:
    """Read the state of the kernel's clock; nothing is set."""
    if subject not in ("", "system"):
        raise UsageError(f"there is no clock '{subject}'", "known: system")
    found = _Timex()
    libc = ctypes.CDLL(None, use_errno=True)
    state = int(libc.adjtimex(ctypes.byref(found)))
    if state < 0:
        why = os.strerror(ctypes.get_errno())
        raise AmberboxError(f"the kernel says nothing of its clock: {why}")
    return judge(state, found)


def judge(state: int, found: _Timex) -> Measured:
    """Return the measurement from the state of the kernel's clock."""
    to_ms = 1e-6 if found.status & _NANOSECONDS else 1e-3
    return {
        "ok": state != _TIME_ERROR and not found.status & _UNSYNCHRONISED,
        "offset_ms": found.offset * to_ms,
        "max_error_ms": found.max_error * 1e-3,
    }
