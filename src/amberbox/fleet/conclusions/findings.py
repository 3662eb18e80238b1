"""What records of robots say, read strictly: a robot may write anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from amberbox.link.positions import LARGEST
from amberbox.monitoring.messages.records import finding_of

_WHOLE = 2**64
"""Numbers of robots have 64 bits, with or without a sign."""


def finding(channel: str, values: Mapping[str, Any]) -> Any:
    """Return what a record says, every field of its type; None for what nobody can read."""
    try:
        found = finding_of(channel, values)
        plain = msgspec.to_builtins(found)
        return msgspec.convert(plain, type(found)) if fits(plain) else None
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def fits(value: object, name: str = "") -> bool:
    """Tell whether all integers of a record fit: times (``..._ns``) into 62 bits, others into 64.

    A time that fits can be shifted by a clock's offset, written as a date, and kept in a column.
    """
    if isinstance(value, Mapping):
        return all(fits(inner, str(key)) for key, inner in value.items())
    if isinstance(value, list | tuple):
        return all(fits(inner, name) for inner in value)
    if type(value) is not int:
        return True
    return abs(value) <= LARGEST if name.endswith("_ns") else abs(value) < _WHOLE
