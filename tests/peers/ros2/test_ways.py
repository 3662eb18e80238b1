"""ROS 2 robots over each way: what is recorded is what they sent, or its loss is counted."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from amberbox.blackbox.sources.ros2 import Config, Source, read_graph
from amberbox.blackbox.sources.ros2_transports import recorded_topics
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import wait_until
from amberbox.testing.contract import ObservedSink, observe
from amberbox.testing.fault_proxy import Proxy
from tests.peers.ros2.robot import IMAGE
from tests.support.processes import apart
from tests.support.ros2_robots import (
    OVER_DDS,
    Ros2Robot,
    Way,
    digests,
    reach,
    recorded,
    robot_of,
)

NUMBER, ODOMETRY = "std_msgs/msg/Int64", "nav_msgs/msg/Odometry"
TCP_WAYS: tuple[Way, ...] = ("bridge", "zenoh")

in_soak = partial(pytest.param, marks=pytest.mark.soak)  # where one robot over DDS is enough


@pytest.fixture(params=[*TCP_WAYS, *OVER_DDS])
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ros2Robot]:
    if request.param == "fastdds":
        request.getfixturevalue("fast_dds")
    with robot_of(request.param, tmp_path) as made:
        yield made


def numbers(sink: ObservedSink, topic: str) -> list[int]:
    return [struct.unpack_from("<q", data, 4)[0] for data in sink.of(topic)]


def kinds(sink: ObservedSink) -> list[str]:
    return [kind for kind, _, _ in sink.events]


def links(sink: ObservedSink, topic: str) -> list[str]:
    return [way for way, name, _, _, _ in sink.links if name == topic]


def test_every_message_of_all_topics_arrives_once_in_order(robot: Ros2Robot) -> None:
    """5,000 messages/s and 1 kHz among 200 topics; a topic that comes later, one that goes."""
    quiet = [f"/part_{number}/state" for number in range(200)]
    for name in ("/count", *quiet):
        robot.offer(name, NUMBER)
    robot.offer("/odom", ODOMETRY)
    with recorded(robot) as sink:
        robot.order("wait", topics=["/count", "/odom", *quiet])
        robot.publish("/count", 5000, rate_hz=5000)
        robot.publish(quiet, 5, rate_hz=5)
        robot.publish("/odom", 1000, rate_hz=1000)
        robot.offer("/later", NUMBER)
        robot.publish_heard("/later", 3)
        for name in ("/count", *quiet, "/odom", "/later"):
            sent = robot.sent(name)
            assert digests(sink.wait_for(name, len(sent))) == sent
        robot.order("withdraw", topic="/later")
        wait_until(lambda: links(sink, "/later") == ["up", "down"])
    assert sink.losses == []
    schemas = {topic.name: topic.schema.name for topic in sink.topics if topic.schema}
    assert schemas["/odom"] == ODOMETRY and not {"ros2_no_definition"} & set(kinds(sink))


@pytest.mark.parametrize("robot", [*TCP_WAYS, in_soak("cyclone"), "fastdds"], indirect=True)
def test_a_robot_that_is_killed_and_comes_back(robot: Ros2Robot, tmp_path: Path) -> None:
    robot.offer("/count", NUMBER)
    with recorded(robot, "/count") as sink:
        robot.publish_heard("/count", 100)
        sink.wait_for("/count", 100)
        robot.kill()
        wait_until(lambda: links(sink, "/count") == ["up", "down"], "the gap opens")
        with robot_of(robot.way, tmp_path, robot.port) as second:
            second.offer("/count", NUMBER)
            second.publish_heard("/count", 100)
            assert digests(sink.wait_for("/count", 200)) == second.sent("/count")
            wait_until(lambda: links(sink, "/count") == ["up", "down", "up"], "it is back")
    assert sink.losses == []


@pytest.mark.parametrize("robot", TCP_WAYS, indirect=True)
def test_a_link_that_is_silent_until_it_is_given_up(robot: Ros2Robot) -> None:
    """What a robot sends meanwhile is counted where messages are numbered, else a gap."""
    robot.offer("/count", NUMBER)
    with Proxy(robot.port) as proxy:
        near = reach(robot.way, proxy.port, dead_after_s=4.0)
        with recorded(robot, "/count", **near) as sink:
            robot.publish_heard("/count", 100)
            sink.wait_for("/count", 100)
            proxy.silence()
            robot.publish("/count", 100, rate_hz=200)
            wait_until(lambda: links(sink, "/count")[:2] == ["up", "down"], "the gap opens")
            wait_until(lambda: links(sink, "/count")[:3] == ["up", "down", "up"], "it is back")
            robot.publish_heard("/count", 100)
            sink.wait_for("/count", 200)
            wait_until(lambda: sink.of("/count")[-1][4:6] == struct.pack("<H", 300), "the last")
    received = numbers(sink, "/count")
    assert received == sorted(set(received)) and received[-1] == 300
    if robot.way == "zenoh":
        missing = sum(loss[4] for loss in sink.losses)
        assert missing == 300 - len(received) > 0


@pytest.mark.parametrize("robot", [*TCP_WAYS, "cyclone", in_soak("fastdds")], indirect=True)
def test_a_robot_that_stands_still_for_a_while(robot: Ros2Robot) -> None:
    robot.offer("/count", NUMBER)
    with recorded(robot, "/count") as sink:
        robot.publish_heard("/count", 10)
        sink.wait_for("/count", 10)
        robot.freeze()
        with pytest.raises(TimeoutError):
            sink.wait_for("/count", 11, timeout_s=4.0)
        robot.thaw()
        robot.publish("/count", 10)
        assert digests(sink.wait_for("/count", 20)) == robot.sent("/count")
        assert links(sink, "/count") == ["up"]


def test_images_of_5_mb_at_10_hz_are_kept(robot: Ros2Robot) -> None:
    """Where publishers do not wait for a busy machine, over DDS and Zenoh, they may be counted."""
    robot.offer("/cam/image", IMAGE)
    with recorded(robot, "/cam/*") as sink:
        robot.publish_heard("/cam/image", 1, size=100)
        sink.wait_for("/cam/image", 1)
        robot.publish("/cam/image", 20, rate_hz=10, size=5_000_000)
        count = robot.publish("/cam/image", 1, size=100)
        last = robot.sent("/cam/image")[-1:]
        wait_until(lambda: digests(sink.of("/cam/image")[-1:]) == last, "the last one")
        # over DDS, what is missing before the first comparison of numbers cannot be known
        unknown = 1 if robot.way in OVER_DDS else 0
        wait_until(
            lambda: (
                len(sink.of("/cam/image")) + sum(loss[4] for loss in sink.losses) >= count - unknown
            )
        )
        kept, sent = digests(sink.of("/cam/image")), robot.sent("/cam/image")
        assert kept == [digest for digest in sent if digest in set(kept)]
        assert kept == sent or (sink.losses and robot.way != "bridge")


def test_a_type_that_changes_in_flight_begins_another_stream(robot: Ros2Robot) -> None:
    robot.offer("/state", NUMBER)
    with recorded(robot, "/state") as sink:
        robot.publish_heard("/state", 5)
        sink.wait_for("/state", 5)
        robot.order("withdraw", topic="/state")
        robot.offer("/state", ODOMETRY)
        robot.publish_heard("/state", 5)
        assert digests(sink.wait_for("/state", 10)) == robot.sent("/state")
    names = [topic.schema.name for topic in sink.topics if topic.schema]
    assert names == [NUMBER, ODOMETRY]
    assert [stream for stream, _, _ in sink.messages] == [0] * 5 + [1] * 5


# CycloneDDS sends nothing that does not fit its types
@pytest.mark.parametrize("robot", [*TCP_WAYS, "fastdds"], indirect=True)
def test_bytes_that_fit_no_type_are_kept_as_they_came(robot: Ros2Robot) -> None:
    # in DDS nothing is data without its head, and all of it is filled up to 4 bytes
    is_dds = robot.way == "fastdds"
    head, sizes = ("00010000", (4, 8, 100, 5000)) if is_dds else ("", (0, 1, 3, 4, 5, 100, 5000))
    robot.offer("/odom", ODOMETRY)
    with recorded(robot, "/odom") as sink:
        robot.order("wait", topics=["/odom"])
        for size in sizes:
            robot.order("raw", topic="/odom", data=head + os.urandom(size).hex())
        assert digests(sink.wait_for("/odom", len(sizes))) == robot.sent("/odom")


def test_what_is_hidden_excluded_or_of_another_type_is_not_recorded(robot: Ros2Robot) -> None:
    action = "action_msgs/msg/GoalStatusArray"
    offered = {"/a/count": NUMBER, "/b/count": NUMBER, "/a/odom": ODOMETRY, "/_hidden": NUMBER}
    for name, type_name in (offered | {"/fly/_action/status": action}).items():
        robot.offer(name, type_name)
    with recorded(robot, exclude=["/b/**"], exclude_types=[ODOMETRY]) as sink:
        robot.publish_heard("/a/count", 1)
        sink.wait_for("/a/count", 1)
        wait_until(lambda: links(sink, "/fly/_action/status") == ["up"])
        assert {topic for _, topic, *_ in sink.links} - {"parameters"} == {
            "/a/count", "/fly/_action/status",
        }  # fmt: skip


def said_of_missing(options: Config) -> list[str]:
    """Run a source until it has reported topics that nobody offers, and return what it says."""
    recorded_topics.UNKNOWN_AFTER_S = 0.3
    with observe(Source(options, "ros2")) as sink:
        wait_until(lambda: "ros2_no_publisher" in kinds(sink))
    return [text for kind, text, _ in sink.events if kind == "ros2_no_publisher"]


def test_a_topic_that_nobody_offers_is_said(robot: Ros2Robot) -> None:
    robot.offer("/count", NUMBER)
    topics = (TopicOptions(name="/counts"), TopicOptions(name="/count"))
    said = apart(said_of_missing, Config(**robot.block(topics=topics)))
    if robot.way in OVER_DDS:  # the other one may not have been found in that short time either
        assert any(text.startswith("no publisher of /counts;") for text in said)
    else:
        (text,) = said
        assert text.startswith("no publisher of /counts; did you mean '/count'?")


def test_the_graph_of_a_robot(robot: Ros2Robot) -> None:
    robot.offer("/count", NUMBER)
    graph = apart(read_graph, Config(**robot.block(all_topics=True)), 5.0)
    (topic,) = [topic for topic in graph.topics if topic.name == "/count"]
    assert topic.type == NUMBER
    if robot.way == "fastdds":  # this one does not say which node it is
        assert len(topic.publishers) == 1
    else:
        assert topic.publishers == ("/talker",)
        assert "/talker" in graph.nodes
