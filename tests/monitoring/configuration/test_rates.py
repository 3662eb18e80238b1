"""Modes that need more rows of an item than its filters keep."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.cli.main import main
from tests.monitoring.configuration.folders import errors, mode_of, notes

BLACK_BOX = """\
- ros:
    topics:
      - topic: {name: /odom, type: nav_msgs/Odometry, max_frequency: 0.5}
      - topic: {name: /imu, type: sensor_msgs/Imu, change: {absolute: 1, heartbeat_s: 30}}
      - topic: {name: /tf, type: sensor_msgs/Imu, keep: none}
      - topic: {name: /frames, type: sensor_msgs/Imu, transforms: {heartbeat_s: 40}}
      - topic: {name: /joints, type: geometry_msgs/Twist}
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
        ("expression", "ros_odom.pose_pose_position_x",
         '{condition: "max(input_1 over 3s) < 3"}', "",
         "looks back over 3 s, but ros_odom comes 0.5 times a second: "
         "what changes between two samples may pass unseen; make it 4 s or more"),
        ("expression", "ros_joints.linear_x", '{condition: "max(input_1 over 20ms) < 3"}', "",
         "looks back over 0.02 s, but at most 20 times a second: "
         "samples between pass unseen; make it 0.1 s or more"),
        ("expression", "ros_imu.linear_acceleration_x",
         '{condition: "max(input_1 over 5s) < 3"}',
         "looks back over 5 s, but while nothing changes ros_imu keeps one row in 30 s (change)",
         ""),
        ("expression", "ros_frames.linear_acceleration_x",
         '{condition: "max(input_1 over 5s) < 3"}',
         "looks back over 5 s, but while nothing changes ros_frames keeps one row in 40 s "
         "(transforms)", ""),
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


def test_windows_are_compared_with_what_was_recorded(tmp_path: Path) -> None:
    """A folder that records everything: only its store shows the rate of an item."""
    log = tmp_path / "pose.csv"
    log.write_text("t,x\n" + "".join(f"{1_700_000_000 + n / 4},{n}\n" for n in range(40)))
    assert main(["import", str(log), "--store", str(tmp_path / "store")]) == 0
    black_box = "- zmq: {name: log, url: tcp://127.0.0.1:5555}\n"
    text = _text("expression", "pose.x", '{condition: "rate(input_1 over 300ms) < 3"}')
    _, problems = mode_of(tmp_path, text, black_box)
    assert [entry for entry in notes(problems) if "unseen" in entry] == [
        "mode.yaml:4: mappings: looks back over 0.3 s, but pose comes 4 times a second: "
        "what changes between two samples may pass unseen; make it 0.5 s or more"
    ]
