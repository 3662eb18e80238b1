"""The simulated robot as a node in a real ROS 1 network, heard by rospy."""

from __future__ import annotations

import subprocess
import sys

from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.simbuses.ros1 import OUTPUTS
from amberbox.testing.clock import PATIENCE_S
from tests.peers.ros.test_play import listen, messages
from tests.support.ros_nodes import Ros, system_state


def test_rospy_hears_what_has_a_standard_type(ros: Ros) -> None:
    ros.processes.master(ros.port)
    kinds = {output.name: message_type(output.type) for output in OUTPUTS.values()}
    heard = listen(ros, [name for name in kinds if name != "/rosout"])
    done = subprocess.run(
        [sys.executable, "-m", "amberbox.sim", "--ros1", ros.uri, "--seed", "7", "--for", "4s"],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = messages(heard)
    assert found.keys() == kinds.keys() - {"/rosout"}
    decoded = {
        name: [kinds[name].decode(bytes.fromhex(one["data"])) for one in all_]
        for name, all_ in found.items()
    }
    for name, all_ in found.items():
        assert {(one["type"], one["md5"]) for one in all_} == {
            (kinds[name].name, kinds[name].md5sum)
        }
    numbers = [one["header"]["seq"] for one in decoded["/odom"]]
    assert numbers == list(range(numbers[0], 201)) and len(numbers) > 50
    assert len(decoded["/scan_front"][-1]["ranges"]) == 181
    assert decoded["/joint_states"][-1]["name"][2] == "front_left_pivot"
    assert not [topic for topic, _ in system_state(ros.port)[0] if topic == "/odom"]
