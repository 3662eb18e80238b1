"""The probe ``ros2_node`` over each way: nodes that are there, that end, and are not known."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.blackbox.sources.ros2_transports import node_watch
from amberbox.core.errors import UsageError
from amberbox.monitoring.probe_runner import load_probe
from amberbox.monitoring.probes import ros2_node
from amberbox.testing.clock import wait_until
from tests.support.processes import free_port
from tests.support.ros2_robots import Ros2Robot, Way, child_process, robot_of

NUMBER = "std_msgs/msg/Int64"
WAYS: tuple[Way, ...] = ("bridge", "zenoh", "cyclone")


@pytest.fixture(autouse=True)
def watches() -> Iterator[None]:
    """End the processes that probes have started."""
    yield
    ros2_node.close()


def at(robot: Ros2Robot) -> str:
    """Return the address of a robot."""
    if robot.way == "bridge":
        return f"ws://127.0.0.1:{robot.port}"
    if robot.way == "zenoh":
        return f"zenoh:tcp/127.0.0.1:{robot.port}"
    return f"dds:{robot.port}?interface=lo&multicast=false"


@pytest.mark.parametrize("way", WAYS)
def test_a_node_is_ok_while_it_is_in_the_graph(way: Way, tmp_path: Path) -> None:
    with robot_of(way, tmp_path) as robot:
        robot.offer("/count", NUMBER)
        talker, nobody = f"/talker@{at(robot)}", f"/nobody@{at(robot)}"
        wait_until(lambda: ros2_node.measure(talker)["ok"], "the node is there")
        assert ros2_node.measure(talker) == {"ok": True, "age_s": 0.0}
        robot.kill() if way == "cyclone" else robot.order("leave")
        wait_until(lambda: ros2_node.measure(talker)["ok"] is False, "the node has ended")
        (first, second) = (ros2_node.measure(talker)["age_s"] for _ in range(2))
        assert 0 < first < second
        wait_until(lambda: ros2_node.measure(nobody)["ok"] is False, "nobody is not there")
        assert ros2_node.measure(nobody) == {"ok": False, "age_s": None}


@pytest.mark.parametrize("way", ["bridge", "zenoh"])
def test_a_node_of_a_robot_that_is_gone_is_unknown(way: Way, tmp_path: Path) -> None:
    with robot_of(way, tmp_path) as robot:
        robot.offer("/count", NUMBER)
        talker = f"/talker@{at(robot)}"
        wait_until(lambda: ros2_node.measure(talker)["ok"], "the node is there")
        robot.kill()
        wait_until(lambda: ros2_node.measure(talker)["ok"] is None, "it is not known any more")
        found = ros2_node.measure(talker)
        assert found["ok"] is None and found["age_s"] > 0 and found["error"]


def test_a_process_that_crashes_is_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meanwhile the node is unknown, never said to be gone."""
    monkeypatch.setattr(node_watch, "AGAIN_S", 0.0)
    with robot_of("zenoh", tmp_path) as robot:
        robot.offer("/count", NUMBER)
        talker = f"/talker@{at(robot)}"
        wait_until(lambda: ros2_node.measure(talker)["ok"], "the node is there")
        started = child_process("node_watch")
        os.kill(started, signal.SIGABRT)
        found = []

        def is_back() -> bool:
            found.append(ros2_node.measure(talker)["ok"])
            return found[-1] is True and child_process("node_watch") != started

        wait_until(is_back, "another process knows that it is there")
        assert False not in found
        ros2_node.close()
        wait_until(lambda: not child_process("node_watch"), "the process ends when it is told to")


def test_a_robot_that_never_answered_is_unknown() -> None:
    found = ros2_node.measure(f"/talker@ws://127.0.0.1:{free_port()}")
    assert (found["ok"], found["age_s"]) == (None, None) and "no connection" in found["error"]


@pytest.mark.parametrize(
    "subject",
    ["", "/a b", "/talker@nowhere", "/talker@dds:x", "/talker@dds:1?interfaces=lo",
     "/talker@dds:233", "/talker@ws://", "/talker@dds:1?multicast=perhaps"],
)  # fmt: skip
def test_what_is_no_node_or_no_way_is_refused(subject: str) -> None:
    with pytest.raises(UsageError):
        ros2_node.measure(subject)
    assert load_probe("ros2_node").measure_once(subject)["ok"] is None
