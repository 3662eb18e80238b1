"""A robot in a process of its own, as ROS 2 shows it by one way, with a truth file.

``python -m tests.peers.ros2.robot WAY PORT TRUTH``; each line of standard input is an order in JSON
and is answered by a line. The truth file has one line per message sent: topic, number, digest.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import sys
import threading
import time
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from amberbox.blackbox.columns.ros2_types import definition_of, type_hash
from amberbox.blackbox.sources.ros2_transports.names import dds_type, zenoh_key
from amberbox.core.types import Schema
from tests.peers.ros2.dds_robots import OFFERS, CycloneRobot, FastDdsRobot

PATIENCE_S = 60.0


class Robot(Protocol):
    """What one way can do."""

    def advertise(self, topic: str, schema: Schema, *, latched: bool) -> None: ...
    def withdraw(self, topic: str) -> None: ...
    def publish(self, topic: str, data: bytes) -> None: ...
    def is_subscribed(self, topic: str) -> bool: ...
    def set(self, name: str, value: Any) -> None: ...


class BridgeRobot:
    """The server of the Foxglove SDK, as ``foxglove_bridge`` runs it."""

    def __init__(self, port: int) -> None:
        import foxglove
        from foxglove.websocket import Capability

        self.context = foxglove.Context()
        self.channels: dict[str, Any] = {}
        self.subscribed: set[str] = set()
        self.parameters: dict[str, Any] = {}
        listener: Any = self
        capabilities = [Capability.Parameters, Capability.ConnectionGraph]
        self.server = foxglove.start_server(
            name="robot", host="127.0.0.1", port=port, capabilities=capabilities,
            server_listener=listener, context=self.context, message_backlog_size=50_000,
        )  # fmt: skip
        graph = foxglove.ConnectionGraph()
        graph.set_published_topic("/count", ["/talker"])
        graph.set_subscribed_topic("/count", ["/listener"])
        graph.set_advertised_service("/reset", ["/talker"])
        self.server.publish_connection_graph(graph)

    def leave(self) -> None:
        """Have the node end, and the bridge go on."""
        import foxglove

        graph = foxglove.ConnectionGraph()
        graph.set_subscribed_topic("/count", ["/listener"])
        self.server.publish_connection_graph(graph)

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.subscribed.add(channel.topic)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        self.subscribed.discard(channel.topic)

    def on_get_parameters(self, client: Any, names: list[str], request_id: str | None) -> Any:
        return self._listed(names or list(self.parameters))

    def on_parameters_subscribe(self, names: list[str]) -> None: ...
    def on_parameters_unsubscribe(self, names: list[str]) -> None: ...
    def on_connection_graph_subscribe(self) -> None: ...
    def on_connection_graph_unsubscribe(self) -> None: ...

    def _listed(self, names: list[str]) -> Any:
        import foxglove

        return [foxglove.Parameter(name, value=self.parameters[name]) for name in names]

    def set(self, name: str, value: Any) -> None:
        self.parameters[name] = value
        self.server.publish_parameter_values(self._listed([name]))

    def advertise(self, topic: str, schema: Schema, *, latched: bool) -> None:
        from foxglove import Channel
        from foxglove import Schema as BridgeSchema

        known = BridgeSchema(name=schema.name, encoding=schema.encoding, data=schema.data)
        self.channels[topic] = Channel(
            topic, schema=known, message_encoding="cdr", context=self.context
        )

    def withdraw(self, topic: str) -> None:
        self.channels.pop(topic).close()
        self.subscribed.discard(topic)

    def publish(self, topic: str, data: bytes) -> None:
        self.channels[topic].log(data, log_time=time.time_ns())

    def is_subscribed(self, topic: str) -> bool:
        return topic in self.subscribed


class ZenohRobot:
    """Nodes that speak as ``rmw_zenoh`` does, and their router, in one session."""

    def __init__(self, port: int) -> None:
        import zenoh

        config = zenoh.Config()
        for key, value in {
            "mode": "router",
            "scouting/multicast/enabled": False,
            "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
            "timestamping/enabled": True,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.publishers: dict[str, Any] = {}
        self.tokens: dict[str, Any] = {}
        self.numbers: dict[str, int] = {}
        self.ids: dict[str, bytes] = {}
        self.entities = 0
        self.node = self._token("NN")

    def _token(self, kind: str, more: str = "") -> Any:
        self.entities += 1
        place = f"@ros2_lv/0/{self.session.zid()}/0/{self.entities}/{kind}/%/%/talker"
        return self.session.liveliness().declare_token(place + more)

    def advertise(self, topic: str, schema: Schema, *, latched: bool) -> None:
        import zenoh.ext

        hashed = type_hash(schema)
        qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        mangled = topic.replace("/", "%")
        self.numbers[topic], self.ids[topic] = 0, os.urandom(16)
        key = zenoh_key(0, topic, schema.name, hashed)
        if latched:
            self.publishers[topic] = zenoh.ext.declare_advanced_publisher(
                self.session, key,
                cache=zenoh.ext.CacheConfig(max_samples=int(os.environ.get(OFFERS, "1"))),
                publisher_detection=True,
            )  # fmt: skip
        else:
            self.publishers[topic] = self.session.declare_publisher(key)
        self.tokens[topic] = self._token("MP", f"/{mangled}/{dds_type(schema.name)}/{hashed}/{qos}")

    def leave(self) -> None:
        """Have the node end, and the router go on."""
        self.node.undeclare()
        for topic in list(self.tokens):
            self.withdraw(topic)

    def withdraw(self, topic: str) -> None:
        self.tokens.pop(topic).undeclare()
        self.publishers.pop(topic).undeclare()

    def publish(self, topic: str, data: bytes) -> None:
        self.numbers[topic] += 1
        attachment = struct.pack(
            "<qqB16s", self.numbers[topic], time.time_ns(), 16, self.ids[topic]
        )
        self.publishers[topic].put(data, attachment=attachment)

    def is_subscribed(self, topic: str) -> bool:
        publisher = self.publishers[topic]
        return not hasattr(publisher, "matching_status") or publisher.matching_status.matching

    def set(self, name: str, value: Any) -> None:
        raise NotImplementedError("parameters of rmw_zenoh are messages of /parameter_events")


ROBOTS: dict[str, Any] = {
    "bridge": BridgeRobot, "zenoh": ZenohRobot, "cyclone": CycloneRobot, "fastdds": FastDdsRobot,
}  # fmt: skip
IMAGE = "sensor_msgs/msg/Image"


def message(type_name: str, number: int, size: int) -> bytes:
    """Return message number ``number`` of a type; ``size`` is that of an image."""
    if type_name == "std_msgs/msg/Int64":
        return struct.pack("<4xq", number).replace(b"\0\0\0\0", b"\0\1\0\0", 1)
    if type_name == IMAGE:
        head = struct.pack("<4xiI", number, 0).replace(b"\0\0\0\0", b"\0\1\0\0", 1)
        head += struct.pack("<I4s", 4, b"cam\0") + struct.pack("<II", 1, size)
        head += struct.pack("<I5sB2xI", 5, b"mono\0", 0, size)
        return head + struct.pack("<I", size) + bytes([number % 256]) * size
    return odometry(number)


@cache
def typestore() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def odometry(number: int) -> bytes:
    """Return an Odometry with known values."""
    store = typestore()
    kind = {name.rpartition("/")[2]: made for name, made in store.types.items()}
    zeros = np.arange(36, dtype="f8") * number
    vector = kind["Vector3"]
    pose = kind["Pose"](kind["Point"](number / 4, -number, 0.5), kind["Quaternion"](0, 0, 0, 1))
    made = kind["Odometry"](
        kind["Header"](kind["Time"](1_700_000_000 + number, 250), "odom"), "base",
        kind["PoseWithCovariance"](pose, zeros),
        kind["TwistWithCovariance"](
            kind["Twist"](vector(number, 0, 0), vector(0, 0, -1)), zeros + 1
        ),
    )  # fmt: skip
    return bytes(store.serialize_cdr(made, "nav_msgs/msg/Odometry"))


class Program:
    """Carries out orders."""

    def __init__(self, robot: Robot, truth: Path) -> None:
        self.robot = robot
        self.truth = truth.open("a", buffering=1 << 16)
        self.types: dict[str, str] = {}
        self.sent: dict[str, int] = {}

    def carry_out(self, order: dict[str, Any]) -> Any:
        """Carry out one order and return its answer."""
        kind = order.pop("do")
        return getattr(self, f"do_{kind}")(**order)

    def do_advertise(
        self, topic: str, type: str, definition: str = "", latched: bool = False
    ) -> None:
        text = definition.encode() or definition_of("jazzy", type)
        self.types[topic] = type
        self.robot.advertise(topic, Schema(type, "ros2msg", text), latched=latched)

    def do_withdraw(self, topic: str) -> None:
        self.robot.withdraw(topic)

    def do_wait(self, topics: list[str]) -> None:
        """Wait until the topics have a subscriber."""
        end_s = time.monotonic() + PATIENCE_S
        while {self.robot.is_subscribed(topic) for topic in topics} != {True}:
            if time.monotonic() > end_s:
                raise TimeoutError("nobody subscribes")
            time.sleep(0.005)

    def do_publish(self, topics: list[str], count: int, rate_hz: float = 0.0, size: int = 0) -> int:
        """Publish messages, one after the other on each topic; return how many on each so far."""
        start_s = time.monotonic()
        for step in range(count):
            for topic in topics:
                number = self.sent[topic] = self.sent.get(topic, 0) + 1
                self._send(topic, number, message(self.types[topic], number, size))
            if rate_hz:
                time.sleep(max(0.0, start_s + step / rate_hz - time.monotonic()))
        self.truth.flush()
        return self.sent[topics[0]]

    def do_leave(self) -> None:
        robot: Any = self.robot
        robot.leave()

    def do_readers(self, topic: str) -> Any:
        robot: Any = self.robot
        return robot.readers(topic)

    def do_raw(self, topic: str, data: str) -> None:
        self._send(topic, 0, bytes.fromhex(data))
        self.truth.flush()

    def do_set(self, name: str, value: Any) -> None:
        self.robot.set(name, value)

    def _send(self, topic: str, number: int, data: bytes) -> None:
        digest = hashlib.blake2b(data, digest_size=8).hexdigest()
        self.truth.write(f"{topic} {number} {digest}\n")
        self.robot.publish(topic, data)


def main(way: str, port: str, truth: str) -> None:
    """Run a robot until standard input ends."""
    program = Program(ROBOTS[way](int(port)), Path(truth))
    print(json.dumps("ready"), flush=True)
    for line in sys.stdin:
        print(json.dumps(program.carry_out(json.loads(line))), flush=True)
    threading.Timer(5.0, os._exit, (0,)).start()  # native threads shall not keep it


if __name__ == "__main__":
    main(*sys.argv[1:])
