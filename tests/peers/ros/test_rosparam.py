"""The parameters of a real ROS master, recorded by the source ``event``."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent

import amberbox
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import recording
from tests.support.ros_nodes import Ros


def test_changed_parameters_of_a_real_master_are_rows_and_events(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    tool = "/usr/bin/rosparam"
    values = {"/base/max_vel": "0.5", "/base/frames": "[map, odom]", "/robot_description": "<r/>"}
    for name, value in values.items():
        ros.processes.output([tool, "set", name, value], ros.port)
    ros.processes.output([tool, "set", "/base/key", "!!binary aGFsbG8="], ros.port)
    (tmp_path / "robot.yaml").write_text("id: r1\n")
    (tmp_path / "black_box.yaml").write_text(
        dedent(f"""\
        - event:
            ros_master_uri: {ros.uri}
            socket: none
            listeners:
              - listener: {{name: rosparam, event_type: ON_CHANGE, max_frequency: 20}}
        """)
    )

    def recorded() -> list[float]:
        with amberbox.open(tmp_path) as record:
            if "event_rosparam" not in {item.name for item in record.items()}:
                return []
            return record.query("event_rosparam").values("base_max_vel")

    with recording(tmp_path):
        wait_until(lambda: recorded() == [0.5], "the parameters are recorded")
        ros.processes.output([tool, "set", "/base/max_vel", "0.8"], ros.port)
        wait_until(lambda: recorded() == [0.5, 0.8], "the change is recorded")
    with amberbox.open(tmp_path) as record:
        found = record.query("amberbox_event", ["kind", "text"])
        first = record.query("event_rosparam", ["base/frames", "base/key", "robot_description"])
    texts = [row["text"] for row in found.rows() if "rosparam" in row["kind"]]
    assert texts == ["/base/max_vel: 0.5 -> 0.8"]
    assert first.values("robot_description") == ["<r/>", "<r/>"]
    assert first.values("base_key")[0].strip() == "aGFsbG8="
