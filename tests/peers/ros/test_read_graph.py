"""The graph of a real ROS 1 system: nodes, types of topics and services, who is at their ends."""

from __future__ import annotations

import pytest

from amberbox.blackbox.sources.ros import Config, read_graph
from amberbox.core.errors import AmberboxError
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import graph_problems
from tests.support.processes import free_port
from tests.support.ros_network import RosMaster
from tests.support.ros_nodes import Ros


def test_the_graph_names_nodes_topics_and_services(ros: Ros) -> None:
    config = Config(ros_master_uri=ros.uri, all_topics=True)
    with pytest.raises(AmberboxError, match="Connection refused"):
        read_graph(config, 5)
    ros.master()
    ros.robot("--topics", "odom,state")

    def is_up() -> bool:
        graph = read_graph(config, PATIENCE_S)
        return {"/robot/odom", "/robot/state"} <= {topic.name for topic in graph.topics}

    wait_until(is_up, "the robot publishes")
    graph = read_graph(config, PATIENCE_S)
    assert "/robot" in graph.nodes
    topics = {topic.name: topic for topic in graph.topics}
    assert topics["/robot/odom"] == GraphTopic(
        "/robot/odom", "nav_msgs/msg/Odometry", ("/robot",), ()
    )
    assert topics["/robot/state"].type == "test_robot/msg/WheelState"
    services = {service.name: service for service in graph.services}
    assert services["/robot/get_loggers"] == GraphService(
        "/robot/get_loggers", "roscpp/srv/GetLoggers", "/robot"
    )
    assert graph_problems(graph) == []


def test_names_that_ros_does_not_allow_and_services_that_are_silent() -> None:
    master = RosMaster()
    try:
        master.register("/odom", "/robot", "http://127.0.0.1:1/")
        master.register("/odom", "/evil\n", "http://127.0.0.1:1/")
        master.register("", "/robot", "http://127.0.0.1:1/")
        master.types["/odom"] = "no type"
        master.services = {"/reset": f"rosrpc://127.0.0.1:{free_port()}", "/x y": "rosrpc://h:1"}
        graph = read_graph(Config(ros_master_uri=master.uri, all_topics=True), PATIENCE_S)
    finally:
        master.stop()
    assert graph == RobotGraph(
        ("/robot", "/server"),
        (GraphTopic("/odom", "", ("/robot",), ()),),
        (GraphService("/reset", "", "/server"),),
    )
    assert graph_problems(graph) == []
