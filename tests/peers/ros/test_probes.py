"""The probes of ROS 1 against a real master and a real node that is killed."""

from __future__ import annotations

import signal

from amberbox.monitoring.probes import ros_master, ros_node, ros_service, ros_topic
from amberbox.testing.clock import wait_until
from tests.support.ros_nodes import Ros, end


def test_a_node_that_is_killed_is_seen_though_the_master_still_lists_it(ros: Ros) -> None:
    address = f"127.0.0.1:{ros.port}"
    assert ros_master.measure(address)["ok"] is False
    ros.master()
    assert ros_master.measure(address)["ok"] is True
    assert ros_node.measure(f"/robot@{address}")["registered"] is False
    robot = ros.robot("--topics", "odom")
    wait_until(lambda: ros_topic.measure(f"/robot/odom@{address}")["ok"], "odom is published")
    found = ros_node.measure(f"/robot@{address}")
    assert found == {"ok": True, "registered": True, "answers": True, "listens": True}
    end(robot, signal.SIGKILL)
    dead = ros_node.measure(f"/robot@{address}")
    assert (dead["ok"], dead["registered"], dead["answers"]) == (False, True, False)
    assert ros_topic.measure(f"/robot/odom@{address}")["publishers"] == 1, "as the master has it"


def test_a_service_is_ok_while_it_is_offered_and_answers(ros: Ros) -> None:
    address = f"127.0.0.1:{ros.port}"
    ros.master()
    robot = ros.robot("--topics", "odom")
    service = f"/robot/get_loggers@{address}"
    wait_until(lambda: ros_service.measure(service)["registered"], "the service is offered")
    wait_until(lambda: ros_service.measure(service)["ok"], "it answers")
    assert ros_service.measure(service) == {
        "ok": True, "registered": True, "listens": True, "answers": True,
        "type": "roscpp/GetLoggers",
    }  # fmt: skip
    assert ros_service.measure(f"/robot/nothing@{address}")["registered"] is False
    robot.send_signal(signal.SIGSTOP)
    hangs = ros_service.measure(service)
    robot.send_signal(signal.SIGCONT)
    assert (hangs["ok"], hangs["listens"], hangs["answers"]) == (False, True, False)
    assert "Inbound TCP/IP connection failed" not in ros.processes.log.read_text()
    end(robot, signal.SIGKILL)
    dead = ros_service.measure(service)
    assert (dead["ok"], dead["registered"], dead["listens"]) == (False, True, False)
