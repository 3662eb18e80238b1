"""Robots over DDS: writers of CycloneDDS from PyPI, and of Fast DDS from Debian."""

from __future__ import annotations

import os
import struct
import subprocess
import time
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import get_types_from_msg

from amberbox.blackbox.columns.ros2_types import type_hash
from amberbox.blackbox.sources.ros2_transports.cyclone import configuration
from amberbox.blackbox.sources.ros2_transports.names import dds_topic, dds_type
from amberbox.core.types import Schema

# a robot that is killed is given up after it; one that stands still for 4 s is not
LEASE_S = int(os.environ.get("LEASE_S", "6"))
KNOWN_S = 0.3  # a writer is told of a reader a little before the reader of it
OFFERS = "OFFERS"  # in the environment: best_effort, or how many messages latched topics keep
ADDRESS = "PEER_ADDRESS"  # of the robot, in the environment; loopback without it
PROGRAM = "FASTDDS_ROBOT"
SOURCE = Path(__file__).with_name("fastdds_robot.cpp")


class Matched:
    """Since when each topic has a reader."""

    def __init__(self) -> None:
        self._since: dict[str, float] = {}

    def is_settled(self, topic: str, is_matched: bool) -> bool:
        if not is_matched:
            self._since.pop(topic, None)
            return False
        return time.monotonic() - self._since.setdefault(topic, time.monotonic()) > KNOWN_S


class CycloneRobot:
    """A process of ``rmw_cyclonedds`` with one node; its writers also send their type objects."""

    def __init__(self, domain: int) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.idl import make_idl_struct
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        address, peer = os.environ.get(ADDRESS, "127.0.0.1"), os.environ.get("PEER")
        xml = configuration(address, [peer] if peer else [], False, 64_000_000)
        xml = xml.replace("<MonitorPort>0</MonitorPort>", "").replace(
            "<SPDPInterval>3s", f"<LeaseDuration>{LEASE_S}s</LeaseDuration><SPDPInterval>30s"
        )
        self.domain = Domain(domain, xml)
        self.participant = DomainParticipant(domain)
        self.writers: dict[str, Any] = {}
        self.matched = Matched()
        types = idl_types()
        gid = types.array[types.uint8, 16]
        prefix = "rmw_dds_common::msg::dds_::"
        fields = {
            "node_namespace": str,
            "node_name": str,
            "reader_gid_seq": types.sequence[gid],
            "writer_gid_seq": types.sequence[gid],
        }
        node = make_idl_struct("Node", prefix + "NodeEntitiesInfo_", fields)
        fields = {"gid": gid, "node_entities_info_seq": types.sequence[node]}
        info = make_idl_struct("Participant", prefix + "ParticipantEntitiesInfo_", fields)
        latched = Qos(
            Policy.Reliability.Reliable(10**8),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
        )
        topic = Topic(self.participant, "ros_discovery_info", info)
        self.told = DataWriter(self.participant, topic, qos=latched)
        self._tell()

    def _tell(self) -> None:
        from cyclonedds._clayer import ddspy_write

        gids = [writer.guid.bytes for writer in self.writers.values()]
        told = [b"\0\1\0\0", self.participant.guid.bytes, struct.pack("<II4s", 1, 2, b"/")]
        told += [struct.pack("<I8sII", 7, b"talker", 0, len(gids)), *gids]
        ddspy_write(self.told._ref, b"".join(told))

    def advertise(self, topic: str, schema: Schema, *, latched: bool) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        qos = Qos(Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(10))
        offers = os.environ.get(OFFERS, "1")
        if offers == "best_effort":
            qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(10))
        elif latched:
            qos = Qos(
                Policy.Reliability.Reliable(10**8),
                Policy.Durability.TransientLocal,
                Policy.History.KeepLast(int(offers)),
                Policy.DurabilityService(0, Policy.History.KeepLast(int(offers)), -1, -1, -1),
            )
        if os.environ.get("TYPE_HASHES"):
            qos += Qos(Policy.Userdata(f"typehash={type_hash(schema)};".encode()))
        made = Topic(self.participant, dds_topic(topic), idl_class(schema))
        self.writers[topic] = DataWriter(self.participant, made, qos=qos)
        self._tell()

    def withdraw(self, topic: str) -> None:
        del self.writers[topic]
        self._tell()

    def publish(self, topic: str, data: bytes) -> None:
        from cyclonedds._clayer import ddspy_write

        ddspy_write(self.writers[topic]._ref, data)

    def is_subscribed(self, topic: str) -> bool:
        matched = self.writers[topic].get_matched_subscriptions()
        return self.matched.is_settled(topic, bool(matched))

    def readers(self, topic: str) -> list[tuple[bool, bool]]:
        """Return whether each reader of a topic is reliable, and whether it reads history."""
        from cyclonedds.core import Policy

        writer, found = self.writers[topic], []
        for handle in writer.get_matched_subscriptions():
            qos = writer.get_matched_subscription_data(handle).qos
            is_reliable = isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable)
            found.append((is_reliable, qos[Policy.Durability] == Policy.Durability.TransientLocal))
        return found

    def set(self, name: str, value: Any) -> None:
        raise NotImplementedError("parameters are messages of /parameter_events")


def idl_types() -> Any:
    """Return the types of fields, which are generic for the package only."""
    from cyclonedds.idl import types

    return types


@cache  # the package takes all memory for more than 32 classes of one name
def idl_class(schema: Schema) -> Any:
    """Make the class of a message type for the package ``cyclonedds``."""
    from cyclonedds.idl import make_idl_struct

    types = idl_types()
    simple = {"bool": bool, "string": str, "octet": types.byte, "byte": types.byte}
    known = get_types_from_msg(schema.data.decode(), schema.name)
    made: dict[str, Any] = {}

    def of(desc: Any) -> Any:
        kind, rest = int(desc[0]), desc[1]
        if kind == 1:
            return simple.get(rest[0]) or getattr(types, rest[0])
        if kind == 2:
            return make(rest)
        inner, length = of(rest[0]), rest[1]
        if kind == 3:
            return types.array[inner, length]
        return types.sequence[inner, length] if length else types.sequence[inner]

    def make(name: str) -> Any:
        if name not in made:
            fields = {label: of(desc) for label, desc in known[name][1]}
            made[name] = make_idl_struct(name.rpartition("/")[2] + "_", dds_type(name), fields)
        return made[name]

    return make(schema.name)


class FastDdsRobot:
    """A process of ``rmw_fastrtps`` of Humble without the names of its nodes: C++ beside this."""

    def __init__(self, domain: int) -> None:
        address = os.environ.get(ADDRESS, "127.0.0.1")
        self.process = subprocess.Popen(
            [os.environ[PROGRAM], str(domain), address, str(LEASE_S)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        self.types: dict[str, str] = {}
        self.matched = Matched()

    def _order(self, letter: str, topic: str, data: bytes = b"") -> bool:
        process = self.process
        assert process.stdin is not None and process.stdout is not None
        frame = [letter.encode()]
        for text in (dds_topic(topic).encode(), dds_type(self.types[topic]).encode(), data):
            frame += [struct.pack("<I", len(text)), text]
        process.stdin.write(b"".join(frame))
        process.stdin.flush()
        return letter == "P" or process.stdout.readline() == b"1\n"

    def advertise(self, topic: str, schema: Schema, *, latched: bool) -> None:
        self.types[topic] = schema.name
        assert self._order("A", topic, b"latched" if latched else b"")

    def withdraw(self, topic: str) -> None:
        self._order("W", topic)

    def publish(self, topic: str, data: bytes) -> None:
        self._order("P", topic, data)

    def is_subscribed(self, topic: str) -> bool:
        return self.matched.is_settled(topic, self._order("M", topic))

    def set(self, name: str, value: Any) -> None:
        raise NotImplementedError("parameters are messages of /parameter_events")
