"""The formats in which statuses are told to others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from amberbox.blackbox.folder.monitoring import Format
from amberbox.core.types import Status
from amberbox.monitoring.messages import diagnostics, health_status, paper
from amberbox.monitoring.messages.naming import Naming

Messages = Callable[[Sequence[Status], Naming], list[dict[str, Any]]]
"""From the statuses of a robot at one time to the messages that say them."""

FORMATS: Mapping[Format, Messages] = {
    "paper": paper.messages,
    "health_status": health_status.messages,
    "diagnostics": diagnostics.messages,
}
