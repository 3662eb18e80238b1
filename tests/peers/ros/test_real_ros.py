"""The ``ros`` source against a real ROS master and rospy publishers that keep their own truth."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amberbox.blackbox.sources.ros import Config, Source
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.ros_nodes import (
    GapSink,
    Ros,
    Verdict,
    body_of,
    end,
    judge,
    read_truth,
    system_state,
)

NAMES = ("odom", "scan", "imu", "battery", "state", "map")
MAP = "/robot/map"  # latched: what was published in a gap is delivered after it
POLL_S = 0.25


@contextmanager
def box(ros: Ros, sink: GapSink, *names: str, invisible: bool = False) -> Iterator[None]:
    """Run the source until the block is left."""
    topics = [TopicOptions(name) for name in names or [f"robot/{name}" for name in NAMES]]
    config = Config(ros_master_uri=ros.uri, topics=topics, invisible=invisible, poll_s=POLL_S)
    stop = threading.Event()
    thread = threading.Thread(target=Source(config, "ros").run, args=(sink, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def bodies(sink: GapSink, topic: str) -> list[str]:
    return [body_of(data, has_header=topic != "/clock") for data in sink.of(topic)]


def verdicts(ros: Ros, *sinks: GapSink, tolerance_s: float = 0.2) -> dict[str, Verdict]:
    """Compare the record of one box, or of one box after the other, with the truth."""
    found = {}
    for topic, truth in ros.published().items():
        heard = [body for sink in sinks for body in bodies(sink, topic)]
        ends = [sink.run_from_ns for sink in sinks[1:]] + [time.time_ns()]
        gaps = [g for sink, at in zip(sinks, ends, strict=True) for g in sink.all_gaps(topic, at)]
        found[topic] = judge(truth, heard, gaps, tolerance_s)
    return found


def assert_right(found: dict[str, Verdict]) -> None:
    wrong = {topic: verdict for topic, verdict in found.items() if not verdict.is_right}
    assert found and not wrong
    wide = {topic: v.needless for topic, v in found.items() if v.needless and topic != MAP}
    assert not wide, "gaps that hold recorded messages"


def count_ups(sink: GapSink, peer: str = "/robot") -> int:
    return sum(1 for way, _, name, _, _ in list(sink.links) if (way, name) == ("up", peer))


def wait_for_links(sink: GapSink, count: int) -> None:
    wait_until(lambda: count_ups(sink) >= count, f"{count} links")


def wait_for_all(sink: GapSink, links: int) -> None:
    """Wait until all topics have had so many links, and messages come over the last of them."""
    wait_for_links(sink, links * len(NAMES))
    wait_for_more(sink)


def wait_for_more(sink: GapSink, topic: str = "/robot/odom", count: int = 15) -> None:
    sink.wait_for(topic, len(sink.of(topic)) + count)


def test_a_healthy_robot_is_recorded_whole(ros: Ros) -> None:
    ros.master()
    sink = GapSink()
    with box(ros, sink):
        robot = ros.robot("--wait-for", "1", "--duration", "2")
        assert robot.wait(PATIENCE_S) == 0
        wait_until(lambda: len(sink.open_gaps) == len(NAMES), "all links closed")
    found = verdicts(ros, sink)
    assert_right(found)
    assert {topic: verdict.missing for topic, verdict in found.items()} == {
        f"/robot/{name}": 0 for name in NAMES
    }
    assert {reason for way, _, _, reason, _ in sink.links if way == "down"} == {"publisher gone"}
    assert sink.events == []
    assert_definitions_come_from_the_wire(ros, sink)


def assert_definitions_come_from_the_wire(ros: Ros, sink: GapSink) -> None:
    entries = read_truth(ros.truths()[0])
    types = next(entry["types"] for entry in entries if entry["k"] == "start")
    schemas = {topic.name: topic.schema for topic in sink.topics}
    for topic, (name, md5sum) in types.items():
        schema = schemas[topic]
        assert schema is not None and schema.name == name
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema.data.decode(), name.replace("/", "/msg/")))
        assert store.generate_msgdef(name.replace("/", "/msg/"))[1] == md5sum
        store.deserialize_ros1(sink.of(topic)[0], name.replace("/", "/msg/"))
    assert [topic.name for topic in sink.topics if topic.latched] == [MAP]


def kill_robot(ros: Ros, sink: GapSink, robot: subprocess.Popen[bytes]) -> None:
    end(robot, signal.SIGKILL)
    wait_until(lambda: len(sink.open_gaps) == len(NAMES), "links down")


@pytest.mark.parametrize("invisible", [False, True])
def test_robot_and_master_are_killed_and_return(ros: Ros, invisible: bool) -> None:
    """Kill the robot alone, then behind its master, then before its master."""
    master = ros.master()
    sink = GapSink()
    with box(ros, sink, invisible=invisible):
        robot = ros.robot()
        wait_for_all(sink, links=1)
        kill_robot(ros, sink, robot)
        robot = ros.robot("--map-seed", "1")
        wait_for_all(sink, links=2)

        end(master, signal.SIGKILL)
        wait_for_more(sink)
        master = ros.master()
        wait_for_more(sink)
        kill_robot(ros, sink, robot)
        robot = ros.robot()
        wait_for_all(sink, links=3)

        kill_robot(ros, sink, robot)
        end(master, signal.SIGKILL)
        ros.master()
        robot = ros.robot()
        wait_for_all(sink, links=4)
        kill_robot(ros, sink, robot)
    assert_right(verdicts(ros, sink, tolerance_s=POLL_S + 0.2 if invisible else 0.2))
    downs = [at for way, _, _, _, at in sink.links if way == "down"]
    assert len(downs) == 4 * len(NAMES)
    assert ("ros_registered_again" in {kind for kind, _, _ in sink.events}) is not invisible


@pytest.mark.parametrize("invisible", [False, True])
def test_the_box_restarts_while_the_master_forgets(ros: Ros, invisible: bool) -> None:
    master = ros.master()
    first = GapSink()
    with box(ros, first, invisible=invisible):
        robot = ros.robot()
        wait_for_links(first, len(NAMES))
        wait_for_more(first)
        first.wait_for(MAP, 1)
    end(master, signal.SIGKILL)
    ros.master()
    second = GapSink(saved=first.saved, latched=first.latched)
    with box(ros, second, invisible=invisible):
        wait_for_links(second, len(NAMES))
        wait_for_more(second)
        end(robot)
    assert_right(verdicts(ros, first, second))
    assert second.of(MAP) == []


def test_the_box_returns_under_the_same_address(ros: Ros) -> None:
    ros.master()
    addresses = []
    saved: dict[str, Any] = {}
    for _ in range(2):
        sink = GapSink(saved=saved)
        with box(ros, sink, "/chatter"):
            wait_until(lambda: _subscribers(ros, "/chatter") == ["/amberbox"], "registered")
            addresses.append(_node_uri(ros, "/amberbox"))
        saved = sink.saved
    assert addresses[0] == addresses[1]
    assert _subscribers(ros, "/chatter") == []


def _subscribers(ros: Ros, topic: str) -> list[str]:
    return [node for name, nodes in system_state(ros.port)[1] if name == topic for node in nodes]


def _node_uri(ros: Ros, node: str) -> str:
    proxy: Any = xmlrpc.client.ServerProxy(ros.uri)
    return str(proxy.lookupNode("/test", node)[2])


def test_an_invisible_box_leaves_no_trace(ros: Ros) -> None:
    ros.master()
    sink = GapSink()
    with box(ros, sink, invisible=True):
        robot = ros.robot()
        wait_for_links(sink, len(NAMES))
        assert "/amberbox" not in str(system_state(ros.port))
        command = ["/usr/bin/rosnode", "list"]
        listing = ros.processes.output(command, ros.port)
        assert listing.split() == ["/robot"]
        end(robot)


def test_clock_and_another_definition_of_a_type(ros: Ros) -> None:
    ros.master()
    sink = GapSink()
    with box(ros, sink, "/clock", "/robot/state"):
        for kind in ("a", "b"):
            options = ["--topics", "clock,state", "--sim-time", "--state-type", kind]
            assert ros.robot(*options, "--wait-for", "1", "--duration", "0.5").wait(PATIENCE_S) == 0
    found = verdicts(ros, sink)
    assert found["/clock"].recorded >= 80
    assert_right(found)
    states = [topic for topic in sink.topics if topic.name == "/robot/state"]
    assert len(states) == 2 and states[0].schema != states[1].schema
    assert "ros_type_changed" in {kind for kind, _, _ in sink.events}


def test_a_publisher_that_waits_for_subscribers_is_not_held_up(ros: Ros) -> None:
    """With ``queue_size=None`` a subscriber that stops reading blocks ``publish()`` for ever."""
    ros.master()
    sink = GapSink()
    with box(ros, sink):
        options = ("--queue-size", "none", "--rate", "imu=1000", "--scan-beams", "50000")
        assert ros.robot(*options, "--wait-for", "1", "--duration", "1.5").wait(PATIENCE_S) == 0
    found = verdicts(ros, sink)
    assert_right(found)
    assert sum(verdict.missing for verdict in found.values()) == 0
    assert next(e["slowest_s"] for e in read_truth(ros.truths()[0]) if e["k"] == "end") < 2


def test_a_box_that_hangs_does_not_stop_the_master(ros: Ros) -> None:
    """A stopped box ties up one of the master's three notification workers, not more."""
    ros.master()
    script = (
        "import sys, threading\n"
        "from amberbox.blackbox.sources.ros import Config, Source\n"
        "from amberbox.core.source import TopicOptions\n"
        "from amberbox.testing.contract import MemorySink\n"
        "topics = [TopicOptions(f'robot/{n}') for n in sys.argv[2].split(',')]\n"
        "config = Config(ros_master_uri=sys.argv[1], topics=topics, caller_id='hanging')\n"
        "Source(config, 'ros').run(MemorySink(), threading.Event())\n"
    )
    hanging = ros.processes.start(
        [sys.executable, "-c", script, ros.uri, ",".join(NAMES)], ros.port
    )
    wait_until(lambda: "/hanging" in _subscribers(ros, "/robot/odom"), "other box registered")
    os.kill(hanging.pid, signal.SIGSTOP)
    sink = GapSink()
    with box(ros, sink):
        wait_until(lambda: "/amberbox" in _subscribers(ros, "/robot/map"), "registered")
        robot = ros.robot()
        wait_for_all(sink, links=1)
        end(robot)
    os.kill(hanging.pid, signal.SIGCONT)
    assert_right(verdicts(ros, sink))
