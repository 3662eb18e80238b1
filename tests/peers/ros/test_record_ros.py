"""The whole box against a real ROS master: every published message is in the store, or in a gap."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.store import journal_reader
from amberbox.core.errors import UsageError
from amberbox.testing.clock import wait_until
from tests.support.processes import command
from tests.support.ros_nodes import Published, Ros, Verdict, body_of, end, judge, read_truth

NAMES = ("odom", "scan", "imu", "battery", "state", "map")
POLL_S = 0.25
GONE = ("publisher gone", "the publisher closed the connection")


class Box:
    """The recorder as a user runs it: a robot folder and a process."""

    def __init__(self, ros: Ros, invisible: bool, all_topics: bool = False) -> None:
        self.folder = ros.folder / "folder"
        self.store = self.folder / "store"
        self.folder.mkdir()
        topics = "".join(f"        - topic: {{name: /robot/{name}}}\n" for name in NAMES)
        extra = f"    invisible: true\n    poll_s: {POLL_S}\n" if invisible else ""
        wanted = "    all_topics: true\n" if all_topics else f"    topics:\n{topics}"
        text = f"- ros:\n    ros_master_uri: {ros.uri}\n{extra}{wanted}"
        (self.folder / "black_box.yaml").write_text(text)
        (self.folder / "robot.yaml").write_text("id: test_robot\n")
        self.log = ros.folder / "box.log"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = {**os.environ, "ROS_IP": "127.0.0.1"}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command("record", self.folder),
                stdout=log, stderr=log, env=environment,
            )  # fmt: skip

    def kill(self) -> None:
        assert self.process is not None
        end(self.process, signal.SIGKILL)

    def stop(self) -> None:
        assert self.process is not None
        end(self.process)
        assert self.process.returncode == 0, self.log.read_text()

    def rows(self, item: str) -> int:
        """Count an item's rows, including those being written."""
        try:
            return sum(
                journal.items.get(item, 0) for journal in journal_reader.journals(self.store)
            )
        except UsageError:  # the store is about to be made
            return 0

    def wait_for_more(self, item: str = "ros_robot_odom", count: int = 15) -> None:
        before = self.rows(item)
        wait_until(lambda: self.rows(item) >= before + count, f"more rows of {item}")

    def losses(self, name: str) -> int:
        """Count how often a publisher of a topic of the robot was gone."""
        gaps = amberbox.open(self.store).gaps(f"ros_robot_{name}")
        return sum(gap.reason in GONE for gap in gaps)

    def wait_for_end(self, robot: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> None:
        """End a robot, and wait until the record tells so: all that it sent was read before."""
        before = {name: self.losses(name) for name in NAMES}
        end(robot, number)
        wait_until(
            lambda: all(self.losses(name) > count for name, count in before.items()), "its end"
        )

    def bodies(self, item: str) -> list[str]:
        """Return the recorded messages of an item, raw and in order, in the form of the
        truth file.
        """
        found = []
        for journal in journal_reader.journals(self.store):
            numbers = [n for n, s in journal.streams.items() if s.item == item and not s.repeated]
            for chunk in journal_reader.sound_chunks(journal):
                rows = np.flatnonzero(np.isin(chunk.channel, numbers))
                found += [body_of(data, has_header=True) for data in chunk.messages(rows)]
        return found


def verdicts(ros: Ros, box: Box, tolerance_s: float) -> dict[str, Verdict]:
    record = amberbox.open(box.store)
    found = {}
    for topic, truth in ros.published().items():
        item = "ros_" + topic.strip("/").replace("/", "_")
        gaps = [(gap.from_ns, gap.to_ns) for gap in record.gaps(item)]
        found[topic] = judge(truth, box.bodies(item), gaps, tolerance_s)
    return found


def assert_all_accounted_for(ros: Ros, box: Box, *, invisible: bool = False) -> None:
    found = verdicts(ros, box, POLL_S + 0.2 if invisible else 0.2)
    wrong = {topic: verdict for topic, verdict in found.items() if not verdict.is_right}
    assert found
    assert not wrong, {t: (v.unexplained[:3], v.repeated[:3], v.in_order) for t, v in wrong.items()}
    assert found["/robot/odom"].recorded > 25


@contextmanager
def running(ros: Ros, *, invisible: bool = False, all_topics: bool = False) -> Iterator[Box]:
    box = Box(ros, invisible, all_topics)
    box.start()
    try:
        wait_until(lambda: box.rows("amberbox_run"), "the box records")
        yield box
    finally:
        if box.process is not None and box.process.poll() is None:
            box.stop()


def test_values_are_equal_to_what_was_published(ros: Ros) -> None:
    ros.master()
    with running(ros) as box:
        robot = ros.robot("--wait-for", "1")
        box.wait_for_more()
        box.wait_for_end(robot)
    assert_all_accounted_for(ros, box)
    record = amberbox.open(box.folder)
    truth: list[Published] = ros.published()["/robot/odom"]
    entries = [e for e in read_truth(ros.truths()[0]) if e["k"] == "pub"]
    stamps = [e["stamp"] for e in entries if e["topic"] == "/robot/odom"]
    table = record.query("ros_robot_odom")
    assert len(table) == len(truth)
    assert np.asarray(table["timestamp"]).tolist() == stamps
    items = {item.name: item for item in record.items()}
    assert items["ros_robot_state"].type == "test_robot/WheelState"
    scan = record.query("ros_robot_scan", ["ranges"])
    assert any(np.isinf(scan["ranges"][row]).any() for row in range(len(scan)))


Act = Callable[[Ros, Box], None]


def kill_box(ros: Ros, box: Box) -> None:
    box.kill()
    time.sleep(0.3)
    box.start()


def kill_robot(ros: Ros, box: Box) -> None:
    end(robots(ros)[-1], signal.SIGKILL)
    time.sleep(0.3)
    ros.robot("--map-seed", str(ros.robots))


def kill_master(ros: Ros, box: Box) -> None:
    end(masters(ros)[-1], signal.SIGKILL)
    time.sleep(0.3)
    ros.master()


def robots(ros: Ros) -> list[subprocess.Popen[bytes]]:
    return [p for p in ros.processes.running if "robot.py" in str(p.args)]


def masters(ros: Ros) -> list[subprocess.Popen[bytes]]:
    return [p for p in ros.processes.running if "rosmaster" in str(p.args)]


ACTS: dict[str, Act] = {"robot": kill_robot, "master": kill_master, "box": kill_box}
EVERY_ORDER = "robot master box robot master robot box master robot"
"""Each of the six orders of the three stands in it."""


@pytest.mark.parametrize(
    ("order", "invisible"), [(EVERY_ORDER, False), ("robot box master box robot", True)]
)
def test_every_message_is_recorded_or_lies_in_a_gap(ros: Ros, order: str, invisible: bool) -> None:
    ros.master()
    with running(ros, invisible=invisible) as box:
        ros.robot()
        box.wait_for_more()
        for act in order.split():
            ACTS[act](ros, box)
            box.wait_for_more()
        box.wait_for_end(robots(ros)[-1])
    assert_all_accounted_for(ros, box, invisible=invisible)


def test_all_topics_are_recorded_after_master_and_box_have_restarted(ros: Ros) -> None:
    ros.master()
    with running(ros, all_topics=True) as box:
        ros.robot()
        box.wait_for_more()
        kill_master(ros, box)
        kill_box(ros, box)
        box.wait_for_more()
        box.wait_for_end(robots(ros)[-1])
    assert_all_accounted_for(ros, box)
