"""Masters, nodes and topics of ROS 1, on a small network that speaks the real protocol."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from amberbox.blackbox.sources.ros1.master import RosNoAnswerError
from amberbox.core.errors import UsageError
from amberbox.monitoring.probes import ros_master, ros_node, ros_service, ros_topic
from amberbox.monitoring.probes._ros import settings_for
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster


@pytest.fixture
def master() -> Iterator[RosMaster]:
    made = RosMaster()
    yield made
    made.stop()


def run_node(*, knows_pid: bool = True) -> SimpleXMLRPCServer:
    """Run a node that answers calls, with or without ``getPid``."""
    node = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)
    name = "getPid" if knows_pid else "getBusStats"
    node.register_function(lambda caller: (1, "", 4711), name)
    threading.Thread(target=node.serve_forever, args=(0.02,), daemon=True).start()
    return node


def uri_of(node: SimpleXMLRPCServer) -> str:
    return f"http://127.0.0.1:{node.server_address[1]}/"


def stop(node: SimpleXMLRPCServer) -> None:
    node.shutdown()
    node.server_close()


def at(name: str, master: RosMaster) -> str:
    return f"{name}@127.0.0.1:{master.port}"


@pytest.mark.parametrize("knows_pid", [True, False])
def test_a_node_is_ok_while_it_answers(master: RosMaster, knows_pid: bool) -> None:
    node = run_node(knows_pid=knows_pid)
    master.register("/scan", "/laser", uri_of(node))
    found = {"ok": True, "registered": True, "listens": True, "answers": True}
    assert ros_node.measure(at("/laser", master)) == found
    stop(node)
    dead = ros_node.measure(at("/laser", master))
    assert (dead["ok"], dead["registered"], dead["answers"]) == (False, True, False)
    assert dead["listens"] is False
    assert "refused" in dead["error"]


def test_a_node_that_the_master_does_not_know_is_not_ok(master: RosMaster) -> None:
    unknown = {"ok": False, "registered": False, "listens": False, "answers": False}
    assert ros_node.measure(at("laser", master)) == unknown


def test_a_node_that_cannot_be_reached_from_here_is_unknown(master: RosMaster) -> None:
    master.register("/scan", "/laser", "http://no-such-host.invalid:4711/")
    found = ros_node.measure(at("/laser", master))
    assert (found["ok"], found["registered"]) == (None, True)
    assert "no-such-host.invalid" in found["error"]


def test_a_node_that_accepts_and_says_nothing_hangs(master: RosMaster) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        master.register("/scan", "/laser", f"http://127.0.0.1:{silent.getsockname()[1]}/")
        found = ros_node.measure(at("/laser", master))
    assert (found["ok"], found["listens"], found["answers"]) == (False, True, False)
    assert "timed out" in found["error"]


def test_a_service_that_cannot_be_reached_from_here_is_unknown(master: RosMaster) -> None:
    master.services["/reset"] = "rosrpc://no-such-host.invalid:4711"
    found = ros_service.measure(at("/reset", master))
    assert (found["ok"], found["registered"]) == (None, True)
    assert "no-such-host.invalid" in found["error"]


def test_a_topic_is_ok_while_somebody_publishes_it(master: RosMaster) -> None:
    subject = at("/scan", master)
    nobody = {"ok": False, "publishers": 0, "subscribers": 0}
    assert ros_topic.measure(subject) == nobody
    master.register("/scan", "/laser", "http://127.0.0.1:9/")
    master.subscribers["/scan"] = {"/a": "http://127.0.0.1:9/", "/b": "http://127.0.0.1:9/"}
    assert ros_topic.measure(subject) == {"ok": True, "publishers": 1, "subscribers": 2}
    assert ros_topic.measure(at("scan", master))["ok"] is True
    master.unregister("/scan", "/laser")
    assert ros_topic.measure(subject)["ok"] is False


def test_a_master_that_answers_and_one_that_does_not(master: RosMaster) -> None:
    master.register("/scan", "/laser", "http://127.0.0.1:9/")
    found = ros_master.measure(f"127.0.0.1:{master.port}")
    assert (found["ok"], found["topics"]) == (True, 1)
    assert 0 < found["latency_ms"] < 2000
    gone = ros_master.measure(f"127.0.0.1:{free_port()}")
    assert gone["ok"] is False
    assert "refused" in gone["error"]


def test_without_a_master_nodes_and_topics_are_unknown() -> None:
    nowhere = f"127.0.0.1:{free_port()}"
    with pytest.raises(RosNoAnswerError, match="refused"):
        ros_topic.measure(f"/scan@{nowhere}")
    with pytest.raises(RosNoAnswerError, match="refused"):
        ros_node.measure(f"/laser@{nowhere}")


def test_only_reading_calls_are_made(master: RosMaster) -> None:
    ros_topic.measure(at("/scan", master))
    ros_node.measure(at("/laser", master))
    ros_master.measure(f"127.0.0.1:{master.port}")
    assert set(master.calls) == {"getSystemState", "lookupNode"}


@pytest.mark.parametrize("subject", ["", "/", "/scan front", "@robot:11311"])
def test_what_is_no_name_is_refused(subject: str) -> None:
    with pytest.raises(UsageError, match="no ROS name"):
        ros_topic.measure(subject)


def test_what_is_no_master_is_refused() -> None:
    with pytest.raises(UsageError, match="no ROS master"):
        ros_master.measure("https://robot:11311")


def test_a_master_is_named_in_short() -> None:
    assert settings_for("robot").master_uri == "http://robot:11311/"
    assert settings_for("robot:11312").master_uri == "http://robot:11312/"
