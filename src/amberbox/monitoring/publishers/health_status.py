"""The predecessor's ``HEALTH-STATUS``: one message for the robot, all components and modes in it.

Its consumers look at ``status`` of each mode: true only where the mode is ok or a warning. What
is unknown or stale is never true, whatever the outputs said last.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Status
from amberbox.monitoring.plan import Naming

TYPE = "HEALTH-STATUS"
MESSAGE_METAMODEL = "ropod-msg-schema.json"
MONITOR_METAMODEL = "ropod-component-monitor-schema.json"

# States of the predecessor's components that can be derived. It has none for a fault without
# recovery: that is ``unknown``, as was every component without a state.
INIT, RUNNING, UNKNOWN = "init", "running", "unknown"


def messages(
    statuses: Sequence[Status], naming: Naming, diagnosis: Diagnosis | None = None
) -> list[dict[str, Any]]:
    """Return the message of a robot, without any diagnosis; none where it has no modes."""
    modes = [status for status in statuses if status.mode]
    components = {status.component: status for status in statuses if not status.mode}
    return [_envelope(modes, components, naming)] if modes else []


def is_functional(status: Status) -> bool:
    """Return whether a mode or component does its work, as far as is known."""
    return status.level in ("ok", "warn")


def state_word(status: Status | None) -> str:
    """Return a component's state in the predecessor's words."""
    if status is None:
        return UNKNOWN
    if status.state == "not_initialised":
        return INIT
    return RUNNING if is_functional(status) else UNKNOWN


def _envelope(
    modes: Sequence[Status], components: Mapping[str, Status], naming: Naming
) -> dict[str, Any]:
    return {
        "header": {
            "type": TYPE,
            "metamodel": MESSAGE_METAMODEL,
            "msgId": str(uuid.uuid4()),
            "timestamp": max(status.measured_ns for status in modes) / NS,
        },
        "payload": {
            "metamodel": MONITOR_METAMODEL,
            "robotId": modes[0].robot,
            "monitors": _monitors(modes, components, naming),
        },
    }


def _monitors(
    modes: Sequence[Status], components: Mapping[str, Status], naming: Naming
) -> list[dict[str, Any]]:
    by_component: dict[str, list[Status]] = {}
    for status in modes:
        by_component.setdefault(status.component, []).append(status)
    return [
        {
            "component": naming.component(of[0]),
            "component_id": component,
            "component_sm_state": state_word(components.get(component)),
            "modes": [
                {
                    "monitorName": naming.monitor(status),
                    "monitorDescription": naming.monitor_description(status),
                    "healthStatus": {**status.outputs, "status": is_functional(status)},
                }
                for status in of
            ],
        }
        for component, of in by_component.items()
    ]
