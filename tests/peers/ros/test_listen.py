"""``doctor --listen`` beside a recorder on a real ROS master; patterns against real nodes."""

from __future__ import annotations

import threading
from pathlib import Path

import amberbox
from amberbox.agent.doctor.listening import MissingTopic, listen
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import recording
from tests.support.ros_nodes import Ros, system_state

PATTERNS = """\
    namespace: /robot
    topics:
      - topic: {name: odom}
      - topic: {name: 's*', max_frequency: 2}
    exclude: [state]
"""
WRONG = """\
    topics: [{name: /robot/odom}, {name: /robot/imuu}, {name: '/robot/*n'}]
"""


def folder(place: Path, ros: Ros, choice: str) -> Path:
    place.mkdir()
    (place / "robot.yaml").write_text("id: r\n")
    (place / "black_box.yaml").write_text(f"- ros:\n    ros_master_uri: {ros.uri}\n{choice}")
    return place


def subscribers(ros: Ros) -> dict[str, set[str]]:
    """Return the topics that each node listens to."""
    found: dict[str, set[str]] = {}
    for topic, nodes in system_state(ros.port)[1]:
        for node in nodes:
            found.setdefault(node, set()).add(topic)
    return found


def test_it_listens_beside_the_recorder_and_names_what_is_missing(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    ros.robot("--topics", "odom,scan,imu,state")
    recorded = folder(tmp_path / "recorded", ros, PATTERNS)
    with recording(recorded) as recorder:
        items = recorder.pipeline.items

        def rows() -> int:
            return items["ros_robot_odom"].counters.received

        wait_until(lambda: "ros_robot_scan" in items and rows() > 10, "both are recorded")
        registered = {"/robot/odom", "/robot/scan"}
        assert subscribers(ros)["/amberbox"] == registered
        stop, seen = threading.Event(), set[str]()

        def watch() -> None:
            def is_there() -> bool:
                seen.update(subscribers(ros).get("/amberbox_doctor", ()))
                return seen >= registered

            wait_until(is_there, "it is registered under a name of its own")
            before = rows()
            wait_until(lambda: rows() > before + 50, "the recorder goes on")
            stop.set()

        watching = threading.Thread(target=watch)
        watching.start()
        (found,) = listen(load_folder(folder(tmp_path / "other", ros, WRONG)), PATIENCE_S, stop)
        watching.join()
        wait_until(lambda: "/amberbox_doctor" not in subscribers(ros), "it has unregistered")
        assert subscribers(ros)["/amberbox"] == registered
        scan = items["ros_robot_scan"].counters
        wait_until(lambda: scan.rate_limited > 0, "the rate of the pattern is kept")
    assert found.connected and not found.trouble
    assert "/amberbox_doctor" in found.passive
    topics = {topic.name: topic for topic in found.topics}
    odom = topics["/robot/odom"]
    assert odom.type == "nav_msgs/Odometry" and odom.messages > 10 and odom.mean_bytes > 600
    assert odom.rate_hz is not None and odom.rate_hz > 10
    assert odom.stamp_age_s is not None and -1 < odom.stamp_age_s < PATIENCE_S
    assert odom.peers == ("/robot",)
    assert topics.keys() == {"/robot/odom", "/robot/scan"}
    not_recorded = {topic.name: topic.type for topic in found.not_recorded}
    assert not_recorded["/robot/imu"] == "sensor_msgs/msg/Imu"
    assert not_recorded.keys() >= {"/robot/imu", "/robot/state", "/rosout"}
    assert found.not_published == (MissingTopic("/robot/imuu", "/robot/imu"),)
    assert not (tmp_path / "other" / "store").exists()
    record = amberbox.open(recorded)
    assert {item.name for item in record.items()} >= {"ros_robot_odom", "ros_robot_scan"}
    assert "ros_robot_state" not in {item.name for item in record.items()}
    assert items["ros_robot_scan"].options.max_frequency == 2
