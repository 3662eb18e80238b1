"""Statuses through a Foxglove bridge: the server of the SDK, which real bridges are built on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import foxglove
import pytest
from foxglove.websocket import Capability, Client, ClientChannel
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.robot_folder.robot_yaml import PublishOptions
from amberbox.blackbox.sources.ros1.message_type import message_type
from amberbox.core.errors import AmberboxError
from amberbox.monitoring.bridge_publisher import BridgePublisher
from amberbox.monitoring.plan import Naming
from amberbox.monitoring.publishers import diagnostics
from amberbox.monitoring.status_publisher import StatusPublisher
from amberbox.testing.clock import wait_until
from tests.monitoring.publishers.laser import PLAN, STATUSES


class Bridge:
    """Receives what clients publish."""

    def __init__(self) -> None:
        self.channels: dict[int, ClientChannel] = {}
        self.received: list[bytes] = []

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        self.channels[channel.id] = channel

    def on_client_unadvertise(self, client: Client, channel_id: int) -> None:
        pass

    def on_message_data(self, client: Client, channel_id: int, data: bytes) -> None:
        self.received.append(data)


@contextmanager
def bridge(*encodings: str, clients_publish: bool = True) -> Iterator[tuple[Bridge, str]]:
    peer = Bridge()
    listener: Any = peer
    server = foxglove.start_server(
        host="127.0.0.1", port=0, server_listener=listener, context=foxglove.Context(),
        capabilities=[Capability.ClientPublish] if clients_publish else [],
        supported_encodings=list(encodings),
    )  # fmt: skip
    try:
        yield peer, f"ws://127.0.0.1:{server.port}"
    finally:
        server.stop()


def heard(peer: Bridge, url: str) -> bytes:
    publisher = StatusPublisher([PublishOptions(url, "diagnostics")], PLAN)
    publisher.open()
    try:
        publisher.publish(STATUSES)
        wait_until(lambda: peer.received, "the array")
        assert [event.kind for event in publisher.events()] == ["publish_connected"]
    finally:
        publisher.close()
    return peer.received[0]


def test_a_bridge_to_ros_1_gets_its_messages() -> None:
    with bridge("ros1") as (peer, url):
        data = heard(peer, url)
    (channel,) = peer.channels.values()
    kind = message_type("diagnostic_msgs/DiagnosticArray")
    assert (channel.topic, channel.encoding, channel.schema_name) == (
        "/diagnostics", "ros1", kind.name,
    )  # fmt: skip
    (expected,) = diagnostics.messages(STATUSES, Naming.of(PLAN))
    assert kind.decode(data) == expected


def test_a_bridge_to_ros_2_gets_cdr() -> None:
    with bridge("cdr", "json") as (peer, url):
        data = heard(peer, url)
    (channel,) = peer.channels.values()
    name = "diagnostic_msgs/msg/DiagnosticArray"
    assert (channel.encoding, channel.schema_name, channel.schema_encoding) == (
        "cdr", name, "ros2msg",
    )  # fmt: skip
    array: Any = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, name)
    (expected,) = diagnostics.messages(STATUSES, Naming.of(PLAN))
    found = [
        (s.level, s.name, s.message, s.hardware_id, [(v.key, v.value) for v in s.values])
        for s in array.status
    ]
    assert found == [
        (s["level"], s["name"], s["message"], s["hardware_id"],
         [(v["key"], v["value"]) for v in s["values"]])
        for s in expected["status"]
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("encodings", "clients_publish", "what"),
    [
        (["ros1"], False, "does not let its clients publish"),
        (["protobuf"], True, "takes none of ros1, cdr, json .but protobuf."),
    ],
)
def test_a_bridge_that_cannot_pass_them_on_is_an_error(
    encodings: list[str], clients_publish: bool, what: str
) -> None:
    with (
        bridge(*encodings, clients_publish=clients_publish) as (_, url),
        pytest.raises(AmberboxError, match=what),
    ):
        BridgePublisher(url, "/diagnostics", lambda: False)


def test_no_bridge_is_an_error_and_the_loss_of_one_is_noticed() -> None:
    with bridge("ros1") as (_, url):
        publisher = BridgePublisher(url, "/diagnostics", lambda: False)
        publisher.check()

    def is_noticed() -> bool:
        try:
            publisher.check()
        except AmberboxError as error:
            assert "closed the connection" in error.what
            return True
        return False

    wait_until(is_noticed, "the loss")
    publisher.close()
    with pytest.raises(AmberboxError, match="no Foxglove bridge answers"):
        BridgePublisher(url, "/diagnostics", lambda: False)
