"""Whether a ROS 1 node is registered with the master and answers a call."""

from __future__ import annotations

import http.client
from xmlrpc.client import Fault

from amberbox.blackbox.ros1.settings import NoAnswerError, RefusedError, Settings
from amberbox.blackbox.ros1.xmlrpc import Api
from amberbox.core.errors import AmberboxError
from amberbox.core.probe import Measured
from amberbox.monitoring.probes._ros import master_of, name_and_settings

MEASURES = {
    "registered": ("bool", "", "whether the master knows it, which it also does after a crash"),
    "answers": ("bool", "", "whether it answers a call; null if it cannot be reached from here"),
}
SUBJECT = "the node, such as /move_base, or /move_base@HOST:PORT for another master"
PERIOD_S = 2.0

_GONE = (ConnectionRefusedError, ConnectionResetError, http.client.RemoteDisconnected)


def measure(subject: str) -> Measured:
    """Ask the master where the node is, and the node for the number of its process."""
    node, settings = name_and_settings(subject)
    try:
        with master_of(settings) as master:
            uri = master.node_uri(node)
    except RefusedError:
        return {"ok": False, "registered": False, "answers": False}
    return {"registered": True, **_call(uri, settings)}


def _call(uri: str, settings: Settings) -> Measured:
    try:
        api = Api(uri, settings)
    except ValueError as error:
        raise AmberboxError(f"the master gives no address of it: {error}") from error
    try:
        api.call("getPid")
    except RefusedError:
        return {"ok": True, "answers": True}
    except NoAnswerError as error:
        return _without_answer(error)
    finally:
        api.close()
    return {"ok": True, "answers": True}


def _without_answer(error: NoAnswerError) -> Measured:
    """Tell a node that is gone from one that has no such call, and from one out of reach."""
    if isinstance(error.__cause__, Fault):
        return {"ok": True, "answers": True}
    if isinstance(error.__cause__, _GONE):
        return {"ok": False, "answers": False, "error": error.what}
    return {"ok": None, "error": error.what}
