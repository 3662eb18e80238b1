"""Folders drafted from what was seen pass the check, and watch what can be watched."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from amberbox.agent.commissioning.draft import RobotDraft, draft_of
from amberbox.agent.commissioning.folder_files import ROBOT, TRIGGERS, drafted_files
from amberbox.agent.commissioning.new_folder import black_box_file, write_files
from amberbox.agent.commissioning.observation import (
    DiagnosticEntry,
    ObservedTopic,
    RobotObservation,
    block_of,
)
from amberbox.agent.commissioning.rate import LearnedRate
from amberbox.cli.main import main
from amberbox.core.robot_graph import GraphService, GraphTopic, RobotGraph

KEYS: dict[str, dict[str, Any]] = {
    "ros": {"ros_master_uri": "http://localhost:11311/"},
    "ros2": {"via": "bridge"},
}
STEADY = LearnedRate(10.0, 9.5, 0.12)


def heard(name: str, kind: str = "", rate: LearnedRate | None = STEADY, **more: Any) -> Any:
    fields = {"latched": False, "count": 200, "mean_bytes": 700.0} | more
    return ObservedTopic(name, kind, rate=rate, **fields)


def seen(plugin: str, graph: RobotGraph, *topics: ObservedTopic, **more: Any) -> RobotObservation:
    keys = "".join(f"    {key}: {value}\n" for key, value in KEYS[plugin].items())
    block = block_of(f"- {plugin}:\n{keys}    all_topics: true\n")
    return RobotObservation(plugin, block, graph, 20.0, topics, **more)


def checked(observation: RobotObservation, place: Path) -> tuple[RobotDraft, Path]:
    """Write the folder of what was seen, check it, and return the draft."""
    draft, plugin = draft_of(observation), observation.plugin
    kind, place_of = ("ros_node", "robot:11311") if plugin == "ros" else ("ros2_node", "dds:0")
    probes = {node: (kind, f"{node}@{place_of}") for node in observation.graph.nodes}
    probes |= {"": ("ros_master", "robot:11311")} if plugin == "ros" else {}
    files = {
        "robot.yaml": ROBOT.replace("{id}", "robot") + TRIGGERS,
        "black_box.yaml": black_box_file(plugin, KEYS[plugin], draft.topics, 20.0),
        **drafted_files(draft, plugin, probes, "made by a test"),
    }
    write_files(place, files)
    assert main(["check", str(place)]) == 0
    return draft, place


def topic(name: str, kind: str, by: str = "", *listeners: str) -> GraphTopic:
    return GraphTopic(name, kind, (by,) if by else (), listeners)


NODES = ("/amcl", "/base", "/laser", "/move_base", "/rviz_1795545826000000", "/amberbox")
ROBOT_TOPICS = (
    topic("/scan", "sensor_msgs/msg/LaserScan", "/laser", "/amcl", "/move_base"),
    topic("/odom", "nav_msgs/msg/Odometry", "/base", "/amcl", "/move_base"),
    topic("/pose", "geometry_msgs/msg/PoseStamped", "/amcl", "/move_base"),
    topic("/cmd_vel", "geometry_msgs/msg/Twist", "/move_base", "/base"),
    topic("/plan", "nav_msgs/msg/Path", "/move_base"),
    topic("/map", "nav_msgs/msg/OccupancyGrid", "/amcl", "/move_base"),
    topic("/image", "sensor_msgs/msg/Image", "/laser"),
    topic("/image/compressed", "sensor_msgs/msg/CompressedImage", "/laser"),
    topic("/events", "std_msgs/msg/String", "/base"),
    topic("/dead", "std_msgs/msg/String", "/base"),
    GraphTopic("/tf", "tf2_msgs/msg/TFMessage", ("/amcl", "/base"), ("/move_base",)),
    GraphTopic("/shared", "std_msgs/msg/String", ("/amcl", "/base")),
    topic("/move_base/status", "actionlib_msgs/msg/GoalStatusArray", "/move_base"),
    GraphTopic("/rosout", "rosgraph_msgs/msg/Log", NODES[:4]),
    topic("/rosout_agg", "rosgraph_msgs/msg/Log", "/rosout"),
    GraphTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", ("/base", "/laser")),
)
HEARD = (
    heard("/scan", "sensor_msgs/LaserScan"),
    heard("/odom", "nav_msgs/Odometry", LearnedRate(50.2, 49.0, 0.03)),
    heard("/pose"), heard("/cmd_vel"), heard("/plan"), heard("/shared"), heard("/tf"),
    heard("/map", rate=None, latched=True, count=1),
    heard("/image", mean_bytes=900_000.0),
    heard("/events", rate=None, count=3),
    heard("/dead", rate=None, count=0),
)  # fmt: skip


def test_a_robot_of_ros_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entries = (
        DiagnosticEntry("laser: Connection (1)", "hokuyo", 0),
        DiagnosticEntry("Battery", "", 2),
    )
    observation = seen("ros", RobotGraph(NODES, ROBOT_TOPICS), *HEARD, entries=entries,
                       errors={"/base": 1})  # fmt: skip
    draft, place = checked(observation, tmp_path)
    assert "robot.yaml" not in capsys.readouterr().out  # no note about the trigger
    assert {c.id: [(n.component, n.topic) for n in c.needs] for c in draft.components} == {
        "amcl": [("base", "/odom"), ("laser", "/scan")],
        "base": [],
        "laser": [],
        "move_base": [("amcl", "/map"), ("base", "/odom"), ("laser", "/scan")],
        "battery": [],
    }
    text = "\n".join(draft.remarks)
    for part in (
        "/rviz_1795545826000000", "/dead (/base)", "/events, /map", "/shared",
        "/base logged 1 error while listening", "'Battery': ERROR already",
    ):  # fmt: skip
        assert part in text
    topics = (place / "components/base/topics.yaml").read_text()
    assert "/odom: 49    # 50.2 Hz on average" in topics
    assert "of: /laser" in (place / "components/laser/log.yaml").read_text()
    names = (place / "components/laser/diagnostics.yaml").read_text()
    assert r'"^laser: Connection \\(1\\)$"' in names
    assert "failed: [4, 5]" in (place / "components/move_base/goals.yaml").read_text()
    needs = (place / "components/amcl.yaml").read_text()
    assert "- base    # guess: it listens to /odom" in needs
    black_box = (place / "black_box.yaml").read_text()
    assert "/image, type: sensor_msgs/Image, keep: ring, max_frequency: 2}" in black_box
    assert "rosout_agg" not in black_box and "compressed" not in black_box
    assert not (place / "components/amberbox.yaml").exists()
    assert main(["fmea", "check", str(place)]) == 0


def test_a_circle_of_needs_is_cut(tmp_path: Path) -> None:
    names = ("/a", "/b", "/c")
    topics = (topic("/x", "", "/a", "/b"), topic("/y", "", "/b", "/c"), topic("/z", "", "/c", "/a"))
    draft, place = checked(
        seen("ros", RobotGraph(names, topics), *map(heard, ("/x", "/y", "/z"))), tmp_path
    )
    assert sum(len(component.needs) for component in draft.components) == 2
    assert "in turn" in "".join(path.read_text() for path in place.glob("components/*.yaml"))


def test_a_robot_of_ros_2_is_known_by_its_connections(tmp_path: Path) -> None:
    nodes = ("/ns/laser", "/nav", "/_ros2cli_12", "/transform_listener_impl_5f")
    graph = RobotGraph(
        nodes,
        (
            topic("/scan", "sensor_msgs/msg/LaserScan", "/ns/laser", "/nav"),
            topic("/go/_action/status", "action_msgs/msg/GoalStatusArray", "/nav"),
            topic("/reset/_service_event", "std_srvs/srv/Trigger_Event", "/nav"),
            topic("/list/_service_event", "a/srv/List_Event", "/nav"),
            GraphTopic("/rosout", "rcl_interfaces/msg/Log", nodes),
        ),
        tuple(GraphService(name, "", "/nav") for name in ("/list", "/reset")),
    )
    draft, place = checked(seen("ros2", graph, heard("/scan")), tmp_path)
    assert [component.id for component in draft.components] == ["ns_laser", "nav"]
    log = (place / "components/ns_laser/log.yaml").read_text()
    assert "of: ns.laser" in log and "level: 40" in log
    calls = (place / "components/nav/calls.yaml").read_text()
    assert "inputs: [ros2_reset__service_event__response]" in calls
    assert "calls/none_failed" in (place / "fmea.yaml").read_text()
    assert "failed: [6]" in (place / "components/nav/goals.yaml").read_text()
    process = (place / "components/nav/process.yaml").read_text()
    assert "kind: ros2_node" in process and "/nav@dds:0" in process and "responds" not in process
    fmea = (place / "fmea.yaml").read_text()
    assert "listed:" in fmea and "ping" not in fmea and "process/running: {within_s: 25" in fmea
    assert main(["fmea", "check", str(place)]) == 0


def test_a_bus_without_nodes_has_components_by_topic(tmp_path: Path) -> None:
    graph = RobotGraph((), (GraphTopic("/arm/joints", "a/msg/B"), GraphTopic("/arm/force")))
    draft, place = checked(seen("ros2", graph, heard("/arm/joints"), heard("/arm/force")), tmp_path)
    assert [component.id for component in draft.components] == ["arm"]
    assert "[/arm/force, /arm/joints]" in (place / "components/arm/topics.yaml").read_text()


def test_an_empty_robot(tmp_path: Path) -> None:
    draft, place = checked(seen("ros", RobotGraph()), tmp_path)
    assert draft.components == () and (place / "components/ros_master.yaml").is_file()


HOSTILE = (
    '/a: {b}, [c] #"d"', "/new\nline: x", "/<component>", "/true", "/" + "x" * 300, "/ünï/ش",
    "/node", "/ros_master", "/node_with_topics", "/../../etc/passwd", "/\x1b[2J", "/'\\'",
)  # fmt: skip


def test_hostile_names_do_no_harm(tmp_path: Path) -> None:
    topics = tuple(topic(f"/t{place}", 'x/"y": {z}', node) for place, node in enumerate(HOSTILE))
    entries = tuple(DiagnosticEntry(f"{node}: {{x}} .*", node, 0) for node in HOSTILE)
    log = GraphTopic("/rosout", "rosgraph_msgs/msg/Log", HOSTILE)
    diagnostics = GraphTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", HOSTILE)
    observation = seen(
        "ros", RobotGraph(HOSTILE, (*topics, log, diagnostics)),
        *(heard(t.name) for t in topics), entries=entries, errors={"\x1b[2J": 1},
    )  # fmt: skip
    draft, place = checked(observation, tmp_path / "folder")
    assert len({component.id for component in draft.components}) == len(HOSTILE)
    written = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert all(path.is_relative_to(place) for path in written)
    assert not any("\x1b" in path.read_text() for path in written)
    assert not any("\x1b" in remark for remark in draft.remarks)
