"""Whether a ROS 1 service is offered and its node answers; the service is not called."""

from __future__ import annotations

from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import RosError, RosRefusedError, SubscriberSettings
from amberbox.blackbox.sources.ros1.service_client import ServiceUnreachableError, probe_service
from amberbox.core.probe import Measured
from amberbox.monitoring.probes._ros import master_of, name_and_settings

MEASURES = {
    "registered": ("bool", "", "whether the master knows it, which it also does after a crash"),
    "listens": ("bool", "", "whether something accepts connections at its address"),
    "answers": ("bool", "", "whether it says its type; null if it cannot be reached from here"),
    "type": ("string", "", "its type, such as std_srvs/Empty"),
}
SUBJECT = "the service, such as /reset, or /reset@HOST:PORT for another master"
PERIOD_S = 2.0

_WAIT_S = 2.0


def measure(subject: str) -> Measured:
    """Request the address from the master, and the type from the service."""
    service, settings = name_and_settings(subject)
    try:
        with master_of(settings) as master:
            master.service_uri(service)
    except RosRefusedError:
        return {"ok": False, "registered": False, "listens": False, "answers": False}
    return {"registered": True, **_ask(service, settings)}


def _ask(service: str, settings: SubscriberSettings) -> Measured:
    try:
        found = probe_service(service, settings, Deadline.within(_WAIT_S))
    except ServiceUnreachableError as error:
        if isinstance(error.__cause__, ConnectionRefusedError):
            return {"ok": False, "listens": False, "answers": False, "error": error.what}
        return {"ok": None, "error": error.what}
    except RosError as error:
        return {"ok": False, "listens": True, "answers": False, "error": error.what}
    return {"ok": True, "listens": True, "answers": True, "type": found.type}
