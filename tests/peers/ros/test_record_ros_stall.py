"""A real rospy publisher that waits for its subscribers, and a box whose disk stalls."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from amberbox.blackbox.journal import writer
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core import files as core_files
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import last_counters, raw_messages
from tests.support.ros_nodes import Ros, body_of, read_truth

RATE_HZ = 1000
STALL_S = 5.0
ITEM = "ros_robot_odom"
QUEUE = "2 MB"
"""Too small for the stall: lost messages must be counted."""


def robot_folder(ros: Ros) -> Path:
    folder = ros.folder / "folder"
    folder.mkdir()
    (folder / "robot.yaml").write_text(f"id: r\nstore: {{queue: {QUEUE}}}\n")
    (folder / "black_box.yaml").write_text(
        f"- ros:\n    ros_master_uri: {ros.uri}\n    advertise: 127.0.0.1\n"
        "    topics: [{name: /robot/odom}]\n"
    )
    return folder


def test_a_publisher_without_a_queue_is_not_slowed_by_a_stalling_disk(
    ros: Ros, monkeypatch: pytest.MonkeyPatch
) -> None:
    works, write = threading.Event(), core_files.write_all

    def stalling(fd: int, data: bytes) -> None:
        works.wait()
        write(fd, data)

    monkeypatch.setattr(writer, "write_all", stalling)
    ros.master()
    folder = robot_folder(ros)
    works.set()
    recorder = Recorder(load_folder(folder), retention=False)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    try:
        robot = ros.robot("--topics", "odom", "--rate", f"odom={RATE_HZ}", "--queue-size", "none",
                          "--wait-for", "1", "--duration", "7")  # fmt: skip
        wait_until(lambda: received(recorder) > 500, "messages")
        works.clear()
        threading.Event().wait(STALL_S)
        works.set()
        assert robot.wait(PATIENCE_S) == 0
    finally:
        works.set()
        recorder.stop.set()
        thread.join(PATIENCE_S)
    truth = read_truth(ros.truths()[0])
    sent = [entry["body"] for entry in truth if entry["k"] == "pub"]
    messages = raw_messages(folder / "store", "/robot/odom")
    kept = [body_of(message, has_header=True) for message in messages]
    recorded = set(kept)
    counters = last_counters(folder / "store")[ITEM]
    assert len(sent) > 3 * RATE_HZ, "the robot was too slow to prove anything"
    (slowest_s,) = (entry["slowest_s"] for entry in truth if entry["k"] == "end")
    assert slowest_s < STALL_S / 2
    assert counters["received"] == len(sent)
    assert [body for body in sent if body in recorded] == kept
    assert counters["dropped"] == len(sent) - len(kept)
    assert counters["dropped"] > RATE_HZ


def received(recorder: Recorder) -> int:
    item = recorder.pipeline.items.get(ITEM)
    return item.counters.received if item else 0
