"""The paper's laser as users run it: a device path, a ROS master and a driver come and go."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.store.own_records import OwnRecords
from amberbox.blackbox.store.store import is_store, open_store
from amberbox.cli.main import main
from amberbox.monitoring.current_state import CurrentStateReader
from amberbox.monitoring.findings import status_of
from amberbox.monitoring.publishers.diagnostics import LEVELS
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.processes import command
from tests.support.ros_nodes import PYTHON, Ros, end, system_state

EXAMPLE = Path(__file__).parents[3] / "examples" / "laser"
DEVICE, HEARTBEAT = "laser_device_monitor", "laser_heartbeat_monitor"
EXPECTED = [
    "nominal -> front_laser_working",
    "front_laser_working -> nominal",
    "nominal -> front_laser_working",
    "front_laser_working -> nominal",
]
"""What the component goes through, once it is initialised."""


@dataclass(frozen=True)
class Laser:
    """A robot folder of the example with a device of its own; what its watcher says of it."""

    folder: Path
    device: Path

    def levels(self) -> dict[str, str]:
        """Return the level of the component (by the empty name) and of its modes."""
        if not is_store(self.folder / "store"):
            return {}
        board = CurrentStateReader(open_store(self.folder / "store")).read(time.time_ns())
        return {status.mode: status.level for status in board.statuses}

    def become(self, **levels: str) -> None:
        """Wait until modes have these levels (``component`` stands for the laser itself)."""
        names = {"component": "", "device": DEVICE, "heartbeat": HEARTBEAT}
        wanted = {names[name]: level for name, level in levels.items()}
        wait_until(lambda: self.levels().items() >= wanted.items(), f"{levels}")

    def messages(self) -> dict[str, Any]:
        """Return what the paper's messages say, by the monitor's name."""
        with redirect_stdout(StringIO()) as shown:
            main(["status", str(self.folder), "--format", "paper"])
        found = [json.loads(line) for line in shown.getvalue().splitlines()]
        assert all(set(m) == {"robotId", "monitorName", "healthStatus"} for m in found)
        return {message["monitorName"]: message["healthStatus"] for message in found}

    def transitions(self) -> list[str]:
        """Return from what to what the component went, in order."""
        with open_record(self.folder) as record:
            texts = [row["text"] for row in record.query("amberbox_event").rows()]
        told = [text for text in texts if text.startswith("laser: ")]
        return [text.split(": ")[1] for text in told]


@contextmanager
def watched(place: Path, uri: str, topic: str) -> Iterator[Laser]:
    """Record and watch the example, with this master, topic, and a path for the device."""
    laser = Laser(place / "laser", place / "front_laser")
    shutil.copytree(EXAMPLE, laser.folder)
    _replace(laser.folder / "black_box.yaml", "http://localhost:11311", uri)
    _replace(laser.folder / "black_box.yaml", "{name: /scan_front, type: sensor_msgs/LaserScan}",
             f"{{name: {topic}}}")  # fmt: skip
    _replace(laser.folder / "components/laser/heartbeat.yaml", "/scan_front", topic)
    _replace(laser.folder / "components/laser/device.yaml", "/dev/front_laser", str(laser.device))
    with (laser.folder / "robot.yaml").open("a") as robot:
        url = uri.replace("http://", "ros://")
        robot.write(f"monitoring: {{publish: [{{url: '{url}', format: diagnostics}}]}}\n")
    laser.device.touch()
    started = [subprocess.Popen(command("record", str(laser.folder), "--quiet"))]
    wait_until(lambda: is_store(laser.folder / "store"), "a store")
    started.append(subprocess.Popen(command("watch", str(laser.folder), "--quiet")))
    try:
        yield laser
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGTERM)
            process.wait(PATIENCE_S)


def play(laser: Laser, stop_driver: Callable[[], None], start_driver: Callable[[], None]) -> None:
    """Unplug the device, stop the driver, and bring both back."""
    laser.become(component="ok", device="ok", heartbeat="ok")
    assert laser.messages()[DEVICE] == {"front_laser_working": True}
    laser.device.unlink()
    laser.become(component="error", device="error", heartbeat="ok")
    assert laser.messages()[DEVICE] == {"front_laser_working": False}
    assert laser.messages()[HEARTBEAT] == {"front_laser_working": True}
    laser.device.touch()
    laser.become(component="ok")
    stop_driver()
    laser.become(component="error", device="ok", heartbeat="error")
    assert laser.messages()[HEARTBEAT] == {"front_laser_working": False}
    start_driver()
    laser.become(component="ok", device="ok", heartbeat="ok")


def _replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_papers_laser(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    drivers = [ros.robot("--topics", "scan")]
    with watched(tmp_path, ros.uri, "/robot/scan") as laser:
        play(
            laser,
            lambda: end(drivers[-1], signal.SIGKILL),
            lambda: drivers.append(ros.robot("--topics", "scan")),
        )
    assert laser.transitions()[-4:] == EXPECTED


LISTENER = Path(__file__).with_name("listener.py")
ARRAY = "diagnostic_msgs/msg/DiagnosticArray"


def entries(heard: Path) -> list[tuple[str, str, int, str]]:
    """Return hardware, name, level and message of all entries that rospy has received."""
    types = get_typestore(Stores.ROS1_NOETIC)
    lines = heard.read_text().splitlines(keepends=True) if heard.exists() else []
    found = []
    for line in (json.loads(line) for line in lines if line.endswith("\n")):
        assert line["md5"] == types.generate_msgdef(ARRAY)[1]
        array: Any = types.deserialize_ros1(bytes.fromhex(line["data"]), ARRAY)
        found += [(s.hardware_id, s.name, s.level, s.message) for s in array.status]
    return found


def test_rospy_hears_the_statuses_as_diagnostics(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    ros.robot("--topics", "scan")
    heard = tmp_path / "heard.jsonl"
    with watched(tmp_path, ros.uri, "/robot/scan") as laser:
        ros.processes.start([PYTHON, str(LISTENER), str(heard), "/diagnostics"], ros.port)
        broken = ("ropod_001", f"laser: {DEVICE}", 2)
        laser.become(component="ok")
        wait_until(lambda: [e for e in entries(heard) if e[1:3] == ("laser", 0)], "a level of OK")
        laser.device.unlink()
        wait_until(lambda: [e for e in entries(heard) if e[:3] == broken], "the fault")
        master: Any = xmlrpc.client.ServerProxy(ros.uri)
        assert dict(master.getTopicTypes("/test")[2])["/diagnostics"] == (
            "diagnostic_msgs/DiagnosticArray"
        )
        laser.become(component="error")
    journal = {
        (s.robot, f"{s.component}: {s.mode}" if s.mode else s.component,
         LEVELS[s.level], s.reason or s.state)
        for s in (status_of(r.values) for r in OwnRecords(
            open_store(laser.folder / "store"), "watch", {channels.STATUS}).step())
    }  # fmt: skip
    told = {entry for entry in entries(heard) if entry[3] != "not evaluated yet"}
    assert told and told <= journal
    assert all(topic != "/diagnostics" for topic, _ in system_state(ros.port)[0])
