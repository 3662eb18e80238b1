"""Whether a ROS 1 node is registered with the master and answers a call."""

from __future__ import annotations

import http.client
import socket
from xmlrpc.client import Fault

from amberbox.blackbox.sources.ros1.master import (
    RosApi,
    RosNoAnswerError,
    RosRefusedError,
    SubscriberSettings,
    host_and_port,
    mapped,
)
from amberbox.core.errors import AmberboxError
from amberbox.core.probe import Measured
from amberbox.monitoring.probes._ros import master_of, name_and_settings

MEASURES = {
    "registered": ("bool", "", "whether the master knows it, which it also does after a crash"),
    "listens": ("bool", "", "whether something accepts connections at its address"),
    "answers": ("bool", "", "whether it answers a call; null if it cannot be reached from here"),
}
SUBJECT = "the node, such as /move_base, or /move_base@HOST:PORT for another master"
PERIOD_S = 2.0

_GONE = (ConnectionRefusedError, ConnectionResetError, http.client.RemoteDisconnected)


def measure(subject: str) -> Measured:
    """Request the node's address from the master, and the process id from the node."""
    node, settings = name_and_settings(subject)
    try:
        with master_of(settings) as master:
            uri = master.node_uri(node)
    except RosRefusedError:
        return {"ok": False, "registered": False, "listens": False, "answers": False}
    return {"registered": True, **_call(uri, settings)}


def _call(uri: str, settings: SubscriberSettings) -> Measured:
    try:
        api = RosApi(uri, settings)
    except ValueError as error:
        raise AmberboxError(f"the master gives no address of it: {error}") from error
    answered: Measured = {"ok": True, "listens": True, "answers": True}
    try:
        api.call("getPid")
    except RosRefusedError:
        return answered
    except RosNoAnswerError as error:
        if isinstance(error.__cause__, Fault):
            return answered
        if isinstance(error.__cause__, _GONE):
            return {"ok": False, "listens": False, "answers": False, "error": error.what}
        if isinstance(error.__cause__, TimeoutError) and _accepts(uri, settings):
            return {"ok": False, "listens": True, "answers": False, "error": error.what}
        return {"ok": None, "error": error.what}
    finally:
        api.close()
    return answered


def _accepts(uri: str, settings: SubscriberSettings) -> bool:
    """Return whether a connection to the node opens: the kernel opens it for a node that hangs."""
    try:
        socket.create_connection(host_and_port(mapped(uri, settings.hosts)), 1.0).close()
    except OSError:
        return False
    return True
