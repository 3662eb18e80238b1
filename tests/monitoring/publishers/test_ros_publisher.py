"""Statuses as a ROS 1 node, on a small network: subscribers get them, and none holds us up."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from amberbox.blackbox.robot_folder.robot_yaml import PublishOptions
from amberbox.blackbox.sources.ros1.deadline import Deadline
from amberbox.blackbox.sources.ros1.master import NodeSettings
from amberbox.blackbox.sources.ros1.message_type import MessageType, message_type
from amberbox.blackbox.sources.ros1.node import RosNode, TopicWish
from amberbox.core.clock import NS
from amberbox.core.types import Diagnosis, Hypothesis
from amberbox.monitoring.background_sender import BackgroundSender
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers import diagnostics
from amberbox.monitoring.status_publisher import StatusPublisher
from amberbox.testing.clock import PATIENCE_S, ManualClock, wait_until
from tests.monitoring.publishers.laser import COMPONENT, OF_DEVICE, PLAN, STATUSES, T0_NS
from tests.support.ros_network import RosMaster

TYPE = "diagnostic_msgs/DiagnosticArray"
NODE = "/amberbox_status_ropod_001"
CAUSES = (
    Hypothesis("a", frozenset({"laser#dead"}), 0.7, explains=("laser/laser_device/front",)),
    Hypothesis("b", frozenset({"power#off"}), 0.2, explains=("laser/laser_device/front",)),
)
DIAGNOSIS = Diagnosis("d-1", 1, "ropod_001", T0_NS, "abc", CAUSES, 0.9)


@pytest.fixture
def master() -> Iterator[RosMaster]:
    made = RosMaster()
    yield made
    made.stop()


def soon() -> Deadline:
    return Deadline.within(PATIENCE_S)


@contextmanager
def publishing(master_uri: str, **how: Any) -> Iterator[StatusPublisher]:
    url = master_uri.replace("http://", "ros://")
    publisher = StatusPublisher([PublishOptions(url, "diagnostics")], PLAN, **how)
    publisher.open()
    try:
        yield publisher
    finally:
        publisher.close()


@contextmanager
def subscribed(master: RosMaster) -> Iterator[list[dict[str, Any]]]:
    """Subscribe to /diagnostics as another node; gives what it receives."""
    heard: list[dict[str, Any]] = []

    def received(node: str, kind: MessageType, data: bytes) -> None:
        heard.append(kind.decode(data))

    settings = NodeSettings(master_uri=master.uri, caller_id="/ear", timeout_s=20.0)
    with RosNode(settings, soon()) as node:
        reader = node.subscribe(TopicWish("/diagnostics", TYPE, received), soon())
        wait_until(lambda: reader.nodes() == {NODE}, "the connection")
        yield heard


def test_a_subscriber_gets_what_is_published(master: RosMaster) -> None:
    unknown = replace(OF_DEVICE, level="unknown", state="unknown", reason="no data")
    failed = replace(COMPONENT, level="error", state="front", reason="front is false")
    with publishing(master.uri) as publisher, subscribed(master) as heard:
        wait_until(lambda: publisher.is_due(), "the first message")
        publisher.publish([failed, unknown], DIAGNOSIS)
        wait_until(lambda: heard, "the array")
        (event,) = publisher.events()
        assert event.kind == "publish_connected"
    (expected,) = diagnostics.messages([failed, unknown], Naming.of(PLAN), DIAGNOSIS)
    header = {"seq": 1, "stamp": {"secs": T0_NS // NS, "nsecs": 0}, "frame_id": ""}
    assert heard == [{**expected, "header": header}]
    component, mode = heard[0]["status"]
    assert (component["name"], component["level"], component["hardware_id"]) == (
        "laser", 2, "ropod_001",
    )  # fmt: skip
    assert (mode["name"], mode["level"], mode["message"]) == (
        "laser: laser_device_monitor", 3, "no data",
    )  # fmt: skip
    values = {entry["key"]: entry["value"] for entry in component["values"]}
    assert values["failure_modes"] == "laser#dead (70%)"
    assert (values["evidence"], values["diagnosis"]) == ("laser/laser_device/front", "d-1")
    assert master.publishers["/diagnostics"] == {}


def test_a_healed_diagnosis_names_no_failure_mode() -> None:
    healed = replace(DIAGNOSIS, state="healed")
    (message,) = diagnostics.messages([COMPONENT], Naming.of(PLAN), healed)
    assert [entry["key"] for entry in message["status"][0]["values"]] == ["state"]


def test_it_registers_with_a_master_that_comes_later_or_starts_anew() -> None:
    first = RosMaster()
    port, uri = first.port, first.uri
    first.stop()
    with publishing(uri) as publisher:
        kinds: list[str] = []

        def happened(kind: str) -> bool:
            kinds.extend(event.kind for event in publisher.events())
            return kind in kinds

        wait_until(lambda: happened("publish_failed"), "the report that there is no master")
        for _ in range(2):  # a master that was started anew knows nobody
            with _restarted(port) as master, subscribed(master) as heard:
                wait_until(partial(_hears, publisher, heard), "a message")


@contextmanager
def _restarted(port: int) -> Iterator[RosMaster]:
    master = RosMaster(port)
    wait_until(lambda: NODE in master.publishers.get("/diagnostics", {}), "the registration")
    yield master
    master.stop()


def _hears(publisher: StatusPublisher, heard: list[dict[str, Any]]) -> bool:
    publisher.changed()
    publisher.publish(STATUSES)
    return bool(heard)


def test_changes_are_published_at_once_and_not_too_often(master: RosMaster) -> None:
    clock = ManualClock()
    with publishing(master.uri, clock_s=lambda: clock.boot_ns() / 1e9) as publisher:
        publisher.publish(STATUSES)
        publisher.changed()
        assert not publisher.is_due()  # at most ten a second
        clock.advance(0.11)
        assert publisher.is_due()
        publisher.publish(STATUSES)
        clock.advance(0.9)
        assert not publisher.is_due()
        clock.advance(0.2)
        assert publisher.is_due()


class HangingPeer:
    """A connection that takes a message and never returns."""

    def __init__(self) -> None:
        self.entered, self.freed = threading.Event(), threading.Event()

    def send(self, message: object) -> None:
        self.entered.set()
        self.freed.wait(PATIENCE_S)

    def check(self) -> None:
        pass

    def dropped(self) -> int:
        return 0

    def close(self) -> None:
        pass


def test_a_peer_that_hangs_delays_nobody_and_drops_are_counted() -> None:
    peer = HangingPeer()
    sender = BackgroundSender("nowhere", lambda stopped: peer)
    sender.start()
    sender.put({"n": 0})
    assert peer.entered.wait(PATIENCE_S)
    for number in range(100):
        sender.put({"n": number})
    assert sender.superseded == 99
    peer.freed.set()
    sender.close()


def test_md5_is_that_of_ros() -> None:
    assert message_type(TYPE).md5sum == "60810da900de1dd6ddd437c3503511da"
