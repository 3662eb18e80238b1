"""``watch --auto`` with real peers of ROS 2: a bridge, Zenoh, and DDS by the robot's folder."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from amberbox.cli.main import main
from amberbox.testing.clock import wait_until
from tests.support.processes import command
from tests.support.ros2_robots import Ros2Robot, Way, robot_of

LIBRARIES: dict[Way, str] = {"bridge": "foxglove", "zenoh": "zenoh", "cyclone": "cyclonedds"}


def where(way: Way, robot: Ros2Robot, folder: Path) -> str:
    """Return what to watch: an address, or a folder where more than that has to be said."""
    if way == "bridge":
        return f"ros2=ws://127.0.0.1:{robot.port}"
    if way == "zenoh":
        return f"ros2=zenoh:tcp/127.0.0.1:{robot.port}"
    folder.mkdir()
    block = {"ros2": robot.block(topics=[{"name": "/count"}])}
    (folder / "black_box.yaml").write_text(f"- {json.dumps(block)}\n")
    return str(folder)


def keep_publishing(robot: Ros2Robot) -> None:
    """Have the robot count until it is killed."""
    robot.offer("/count", "std_msgs/msg/Int64")

    def publish() -> None:
        with suppress(AssertionError, OSError, ValueError):  # its pipe ends with the robot
            robot.publish("/count", 1_000_000, rate_hz=20)

    threading.Thread(target=publish, daemon=True).start()


def watched(robot_at: str, folder: Path, log: Path) -> subprocess.Popen[bytes]:
    """Watch a robot without configuration, once its topic is steady while it listens."""
    while True:
        with log.open("wb") as output:
            process = subprocess.Popen(
                command("watch", "--auto", robot_at, "--listen", "5", "--keep", folder),
                stdout=output, stderr=output, env=os.environ,
            )  # fmt: skip
        wait_until(lambda: "talker: not_initialised -> nominal" in log.read_text(), "nominal")
        if "not watched: /count" not in log.read_text():
            return process
        process.terminate()  # the machine stood still for half a second
        process.wait()
        shutil.rmtree(folder)


@pytest.mark.parametrize("way", LIBRARIES)
def test_a_robot_that_dies_is_named_without_configuration(way: Way, tmp_path: Path) -> None:
    pytest.importorskip(LIBRARIES[way])
    folder, log = tmp_path / "robot", tmp_path / "log"
    with robot_of(way, tmp_path) as robot:
        keep_publishing(robot)
        process = watched(where(way, robot, tmp_path / "configured"), folder, log)
        try:
            robot.kill()
            wait_until(lambda: "talker#died" in log.read_text(), "the diagnosis")
        finally:
            process.terminate()
            process.wait()
    assert process.returncode == 0, log.read_text()
    assert main(["check", str(folder)]) == 0
    topics = (folder / "components" / "talker" / "topics.yaml").read_text()
    assert "/count: 1" in topics or "/count: 2" in topics  # 20 Hz, less what a busy machine takes


RULE = "\n" + "=" * 80 + "\nMSG: "
EVENT = RULE.join([
    "service_msgs/ServiceEventInfo info\nstd_srvs/srv/Trigger_Request[<=1] request\n"
    "std_srvs/srv/Trigger_Response[<=1] response",
    "service_msgs/ServiceEventInfo\nuint8 event_type\nbuiltin_interfaces/Time stamp\n"
    "char[16] client_gid\nint64 sequence_number",
    "builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
    "std_srvs/srv/Trigger_Request\nuint8 structure_needs_at_least_one_member",
    "std_srvs/srv/Trigger_Response\nbool success\nstring message",
])  # fmt: skip


def answer(success: bool) -> str:
    """Return the event of an answer, ``RESPONSE_SENT``, as an order publishes it."""
    info = struct.pack("<BxxxiI16sxxxxq", 2, 1_700_000_000, 0, b"client", 1)
    return (b"\0\1\0\0" + info + struct.pack("<II?xxxI6s", 0, 1, success, 6, b"stuck\0")).hex()


def test_a_service_whose_call_fails_is_named_without_configuration(tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    folder, log, topic = tmp_path / "robot", tmp_path / "log", "/reset/_service_event"
    with robot_of("bridge", tmp_path) as robot:
        robot.offer(topic, "std_srvs/srv/Trigger_Event", definition=EVENT)
        place = where("bridge", robot, tmp_path)
        with log.open("wb") as output:
            process = subprocess.Popen(
                command("watch", "--auto", place, "--listen", "2", "--keep", folder),
                stdout=output, stderr=output,
            )  # fmt: skip
        try:
            wait_until(lambda: "talker: not_initialised -> nominal" in log.read_text(), "nominal")
            robot.order("raw", topic=topic, data=answer(True))
            robot.order("raw", topic=topic, data=answer(False))
            wait_until(lambda: "talker#call_fails" in log.read_text(), "the diagnosis")
        finally:
            process.terminate()
            process.wait()
    assert "a call failed within the last 10 s" in log.read_text()
