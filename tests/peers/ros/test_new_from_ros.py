"""``new --from ros`` and ``watch --auto`` on a real robot of rospy nodes."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.testing.clock import wait_until
from tests.support.processes import command
from tests.support.ros_nodes import Ros, end, system_state


def ready(ros: Ros, *options: str) -> subprocess.Popen[bytes]:
    """Start the test robot, and wait until the master knows its topics."""
    robot = ros.robot(*options)
    wait_until(lambda: "/robot/odom" in dict(system_state(ros.port)[0]), "the robot publishes")
    return robot


def test_a_folder_is_written_of_what_runs(
    ros: Ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    ros.master()
    ready(ros)
    place = tmp_path / "folder"

    def hears_regular_topics() -> bool:
        """Write a folder; a robot that was not scheduled for a while is heard again."""
        shutil.rmtree(place, ignore_errors=True)
        assert main(["new", str(place), "--from", f"ros={ros.uri}", "--listen", "6"]) == 0
        return "latched or irregular, not watched: /robot/map" in capsys.readouterr().out

    wait_until(hears_regular_topics, "rates of all topics but the latched one")
    assert main(["check", str(place)]) == 0
    topics = (place / "components" / "robot" / "topics.yaml").read_text()
    measured = dict(line.split(":", 1) for line in topics.split("rates:")[1].splitlines()[1:])
    rates = {name.strip(): float(text.split("#")[0]) for name, text in measured.items()}
    assert set(rates) == {f"/robot/{n}" for n in ("odom", "scan", "imu", "battery", "state")}
    for name, rate_hz in (("odom", 50), ("scan", 10), ("imu", 100), ("state", 5)):
        assert 0.5 * rate_hz < rates[f"/robot/{name}"] <= 1.1 * rate_hz
    black_box = (place / "black_box.yaml").read_text()
    assert "{name: /robot/state, type: test_robot/WheelState}" in black_box


def test_nothing_at_an_address_is_an_error(tmp_path: Path, ros: Ros) -> None:
    assert main(["new", str(tmp_path / "a"), "--from", f"ros={ros.uri}"]) != 0
    assert main(["watch", "--auto", f"ros={ros.uri}"]) != 0
    assert not (tmp_path / "a").exists()


def watching(ros: Ros, log: Path, *words: object) -> subprocess.Popen[bytes]:
    """Start ``watch --auto``; its temporary folders are beside its log."""
    environment = os.environ | {"ROS_IP": "127.0.0.1", "TMPDIR": str(log.parent)}
    with log.open("wb") as output:
        return subprocess.Popen(
            command("watch", "--auto", f"ros={ros.uri}", *words),
            stdout=output, stderr=output, env=environment,
        )  # fmt: skip


def test_watching_without_configuration_names_a_fault_and_keeps_its_record(
    ros: Ros, tmp_path: Path
) -> None:
    ros.master()
    robot = ready(ros)
    folder, log = tmp_path / "kept", tmp_path / "log"
    process = watching(ros, log, "--listen", "4", "--keep", folder)
    try:
        wait_until(lambda: "robot: not_initialised -> nominal" in log.read_text(), "nominal")
        end(robot, signal.SIGKILL)
        wait_until(lambda: "robot#died" in log.read_text(), "the diagnosis")
        wait_until(lambda: load_all(open_store(folder / "store")), "an incident")
    finally:
        end(process)
    assert process.returncode == 0, log.read_text()
    assert "alarm robot-" in log.read_text()


def test_watching_without_a_folder_leaves_nothing(ros: Ros, tmp_path: Path) -> None:
    ros.master()
    ready(ros)
    place = tmp_path / "tmp"
    place.mkdir()
    process = watching(ros, place / "log", "--listen", "1")
    try:
        wait_until(lambda: list(place.glob("amberbox-auto-*/robot/store/journal")), "a record")
    finally:
        end(process)
    assert process.returncode == 0
    assert [path.name for path in place.iterdir()] == ["log"]
    assert "--keep DIR keeps it" in (place / "log").read_text()
