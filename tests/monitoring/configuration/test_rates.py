"""Modes that want to see more of an item than its filters leave."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.monitoring.configuration.folders import errors, mode_of, notes

BLACK_BOX = """\
- ros:
    topics:
      - topic: {name: /odom, type: nav_msgs/Odometry, max_frequency: 0.5}
      - topic: {name: /imu, type: sensor_msgs/Imu, change: {absolute: 1, heartbeat_s: 30}}
      - topic: {name: /tf, type: sensor_msgs/Imu, keep: none}
"""


def _text(monitor: str, text: str, arguments: str) -> str:
    return f"""\
name: x
monitor: {monitor}
arguments: {arguments}
mappings:
  - {{inputs: ["{text}"], outputs: [{{name: a, type: bool}}]}}
"""


@pytest.mark.parametrize(
    ("monitor", "text", "arguments", "error", "note"),
    [
        ("heartbeat", "/odom", "{rate: 0.5}", "", ""),
        ("heartbeat", "/odom", "{rate: 20}", "",
         "expects 20 Hz, ros_odom keeps at most 0.5 Hz (max_frequency): "
         "it counts what is received, not what is kept"),
        ("heartbeat", "/tf", "{rate: 20}", "ros_tf is not recorded (keep: none)", ""),
        ("expression", "ros_odom.pose_pose_position_x",
         '{condition: "max(input_1 over 1s) < 3"}',
         "looks back over 1 s, but ros_odom keeps one row in 2 s (max_frequency)", ""),
        ("expression", "ros_odom.pose_pose_position_x",
         '{condition: "max(input_1 over 5s) < 3"}', "", ""),
        ("expression", "ros_imu.linear_acceleration_x",
         '{condition: "max(input_1 over 5s) < 3"}',
         "looks back over 5 s, but while nothing changes ros_imu keeps one row in 30 s (change)",
         ""),
        ("range", "ros_imu.linear_acceleration_x", "{max: 3}", "", ""),
    ],
)  # fmt: skip
def test_filters(
    tmp_path: Path, monitor: str, text: str, arguments: str, error: str, note: str
) -> None:
    mode, problems = mode_of(tmp_path, _text(monitor, text, arguments), BLACK_BOX)
    place = "mode.yaml:4: mappings: "
    assert errors(problems) == ([place + error] if error else [])
    assert [entry for entry in notes(problems) if "inputs" not in entry] == (
        [place + note] if note else []
    )
    assert mode.problem == error
