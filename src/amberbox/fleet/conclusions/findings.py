"""What records of robots say, read strictly: a robot may write anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from amberbox.monitoring.messages.records import finding_of


def finding(channel: str, values: Mapping[str, Any]) -> Any:
    """Return what a record says, every field of its type; None for what nobody can read."""
    try:
        found = finding_of(channel, values)
        return msgspec.convert(msgspec.to_builtins(found), type(found))
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None
