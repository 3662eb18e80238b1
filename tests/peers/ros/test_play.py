"""``amberbox play`` into a real ROS 1 network, received by rospy."""

from __future__ import annotations

import json
import signal
import struct
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import COUNT, ManualBox, number
from tests.support.processes import command
from tests.support.ros_nodes import PYTHON, Ros, system_state

COUNTS = 900
START_S = 1_700_000_004
"""What is played in part begins then: 2023-11-14T22:13:24Z."""
LISTENER = Path(__file__).with_name("listener.py")
NAME = Topic("/name", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), latched=True)
SPEED = Topic("/cmd_vel", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"))


def listen(ros: Ros, topics: Sequence[str]) -> Path:
    """Start a rospy node that writes down what it hears, and wait until it is registered."""
    heard = ros.folder / f"heard-{len(ros.processes.running)}.jsonl"
    ros.processes.start([PYTHON, str(LISTENER), str(heard), *topics], ros.port)
    wait_until(lambda: subscribed(ros) >= set(topics), "the subscriptions")
    return heard


def subscribed(ros: Ros) -> set[str]:
    return {topic for topic, _ in system_state(ros.port)[1]}


def messages(heard: Path) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for line in heard.read_text().splitlines(keepends=True):
        if line.endswith("\n"):
            message = json.loads(line)
            found.setdefault(message["topic"], []).append(message)
    return found


def data(heard: Path) -> dict[str, list[bytes]]:
    return {t: [bytes.fromhex(m["data"]) for m in all_] for t, all_ in messages(heard).items()}


def play(ros: Ros, where: object, *options: object) -> subprocess.CompletedProcess[str]:
    words = command("play", where, "--to", f"ros={ros.uri}", *options)
    return subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """Counts at 100 Hz for 9 s, a latched name that changes, and commands.

    They are fewer than rospy's queue holds, which else drops what it reads at once.
    """
    box = ManualBox(tmp_path / "store")
    for count in range(COUNTS):
        if count in (0, 300):
            box.hear(NAME, b"\x04\0\0\0%04d" % count)
        box.hear(COUNT, number(count))
        if count % 10 == 0:
            box.hear(SPEED, b"\x04\0\0\0fast")
        box.write(0.01)
    box.close()
    return box.store


def hears_all(heard: Path, expected: Mapping[str, Sequence[bytes]]) -> None:
    wait_until(
        lambda: (
            {t: len(m) for t, m in data(heard).items()} == {t: len(m) for t, m in expected.items()}
        ),
        "all messages",
    )
    assert data(heard) == expected


def test_rospy_hears_all_and_nothing_that_moves(ros: Ros, store: Path) -> None:
    ros.master()
    heard = listen(ros, ["/count", "/name", "/cmd_vel"])
    done = play(ros, store, "--speed", "max", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["counts"] == {"/count": COUNTS, "/name": 2}
    assert (report["dropped"], report["unheard"], list(report["left_out"])) == (0, 0, ["/cmd_vel"])
    names = [b"\x04\0\0\0%04d" % count for count in (0, 300)]
    hears_all(heard, {"/count": [number(n) for n in range(COUNTS)], "/name": names})
    assert {m["latching"] for m in messages(heard)["/name"]} == {"1"}
    assert all(topic not in ("/count", "/name") for topic, _ in system_state(ros.port)[0])


def test_a_part_is_played_at_its_pace_under_other_names(ros: Ros, store: Path) -> None:
    ros.master()
    heard = listen(ros, ["/replay/count", "/replay/name", "/replay/cmd_vel", "/clock"])
    options = ["--prefix", "/replay", "--from", str(START_S), "--speed", "10", "--clock"]
    done = play(ros, store, *options, "--with-commands", "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["duration_s"] >= 0.49 and report["counts"]["/replay/count"] == 500
    wait_until(lambda: clock(heard) and clock(heard)[-1] > START_S + 4.5, "the clock")
    assert clock(heard) == sorted(clock(heard))
    assert clock(heard)[0] >= START_S and clock(heard)[-1] <= START_S + 5.0
    expected = [number(n) for n in range(400, 900)]
    wait_until(lambda: len(data(heard)["/replay/count"]) == 500, "the counts")
    assert data(heard)["/replay/count"] == expected
    assert data(heard)["/replay/name"] == [b"\x04\0\0\0" + b"0300"]  # latched before the start
    wait_until(lambda: len(data(heard)["/replay/cmd_vel"]) == 50, "the commands")


def clock(heard: Path) -> list[float]:
    """Return the times on /clock, seconds."""
    found = [struct.unpack("<II", message) for message in data(heard).get("/clock", [])]
    return [secs + nsecs / 1e9 for secs, nsecs in found]


def test_it_does_not_play_into_a_robot_that_runs_and_ends_with_ctrl_c(
    ros: Ros, store: Path
) -> None:
    ros.master()
    heard = listen(ros, ["/count"])
    words = command("play", store, "--to", f"ros={ros.uri}", "--loop", "--json")
    first = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: heard.exists() and data(heard), "the first messages")
        second = play(ros, store)
        assert second.returncode == 2
        assert "publish these topics themselves: " in second.stderr
        assert f"/count (/amberbox_play_{first.pid})" in second.stderr
        first.send_signal(signal.SIGINT)
        out, err = first.communicate(timeout=PATIENCE_S)
    finally:
        first.kill()
    assert (first.returncode, err) == (0, "")
    assert json.loads(out)["counts"]["/count"] >= len(data(heard)["/count"])


@pytest.mark.needs_data
@pytest.mark.parametrize("name", ["plotjuggler_tilt_laser.bag", "imu_ardrone.bag"])
def test_a_real_bag(ros: Ros, shared_data: Path, name: str) -> None:
    bag = shared_data / "recordings" / name
    expected: dict[str, list[bytes]] = {}
    with AnyReader([bag]) as reader:
        for connection, _, message in reader.messages():
            expected.setdefault(connection.topic, []).append(bytes(message))
    ros.master()
    heard = listen(ros, list(expected))
    done = play(ros, bag, "--speed", "max", "--with-commands", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["left_out"] == {}
    hears_all(heard, expected)
