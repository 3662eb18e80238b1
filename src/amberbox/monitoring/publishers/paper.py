"""The status message of the paper (listing 6): one for each mode, robot, monitor and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.plan import Naming


def messages(
    statuses: Sequence[Status], naming: Naming, diagnosis: Diagnosis | None = None
) -> list[dict[str, Any]]:
    """Return one message for each mode; neither components nor a diagnosis have any."""
    return [message(status, naming) for status in statuses if status.mode]


def message(status: Status, naming: Naming) -> dict[str, Any]:
    """Return the message of one mode; an output that is unknown is null."""
    return {
        "robotId": status.robot,
        "monitorName": naming.monitor(status),
        "healthStatus": dict(status.outputs),
    }
