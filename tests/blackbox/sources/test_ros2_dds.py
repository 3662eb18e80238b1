"""ROS 2 over DDS: what discovery says of nodes and types, and counts of what is missing."""

from __future__ import annotations

import importlib.metadata
import struct
from dataclasses import dataclass
from typing import Any

import pytest
from cyclonedds.idl import IdlStruct, make_idl_struct
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns.ros2_types import definition_of, type_hash
from amberbox.blackbox.sources import ros2
from amberbox.blackbox.sources.ros2_transports import cyclone, discovery_info
from amberbox.blackbox.sources.ros2_transports.dds import Numbers
from amberbox.blackbox.sources.ros2_transports.discovery_info import NodeEndpoints, nodes_of
from amberbox.blackbox.sources.ros2_transports.xtypes import schema_of_type
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema
from tests.peers.ros2.dds_robots import idl_class

GIDS = [bytes([number] * 16) for number in range(3)]


def told(gid_bytes: int, name: bytes = b"talker") -> bytes:
    """Return what a process says of its one node, in the layout of new and old distributions."""
    own, *others = (gid.ljust(gid_bytes, b"\0") for gid in GIDS)
    text = struct.pack("<I2sxx", 2, b"/\0") + struct.pack("<I", len(name) + 1) + name + b"\0"
    body = own + struct.pack("<I", 1) + text
    body += bytes(-len(body) % 4) + struct.pack("<I", 1) + others[0] + struct.pack("<I", 1)
    return b"\0\1\0\0" + body + others[1]


@pytest.mark.parametrize("gid_bytes", [16, 24])
def test_nodes_are_read_as_old_and_new_distributions_say_them(gid_bytes: int) -> None:
    node = NodeEndpoints("/talker", (GIDS[1],), (GIDS[2],))
    assert nodes_of(told(gid_bytes)) == (GIDS[0], [node])


@given(st.binary(max_size=300), st.integers(0, 120), st.sampled_from([16, 24]))
def test_what_is_no_such_message_is_refused(noise: bytes, cut: int, gid_bytes: int) -> None:
    whole = told(gid_bytes)
    for data in (noise, whole[:cut], whole[:cut] + noise, whole + b"1234", told(16, b"a b")):
        try:
            participant, nodes = nodes_of(data)
        except ValueError:
            continue
        assert len(participant) == 16
        assert all(len(gid) == 16 for node in nodes for gid in (*node.readers, *node.writers))


def test_a_hash_is_read_from_user_data_and_nothing_else() -> None:
    hashed = "RIHS01_" + "0f" * 32
    assert discovery_info.type_hash_of(f"typehash={hashed};".encode()) == hashed
    assert discovery_info.type_hash_of(f"enclave=/;typehash={hashed};x=1;".encode()) == hashed
    for other in (b"", b"typehash=RIHS01_00;", f"atypehash={hashed};".encode(), b"\xff" * 99):
        assert discovery_info.type_hash_of(other) == ""


@pytest.mark.parametrize(
    "name",
    ["nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2", "rcl_interfaces/msg/ParameterEvent"],
)
def test_a_type_object_gives_the_definition_with_the_hash_of_ros(name: str) -> None:
    known = Schema(name, "ros2msg", definition_of("jazzy", name))
    made = schema_of_type(idl_class(known))
    assert (made.name, made.encoding) == (name, "ros2msg")
    assert type_hash(made) == type_hash(known)


def test_types_that_are_none_of_ros_are_refused() -> None:
    def struct_of(name: str, **fields: object) -> object:
        return make_idl_struct("Made", name, fields)

    inner = struct_of("other::Inner", a=bool)
    ours = "p::msg::dds_::T_"
    for wrong in (
        struct_of("Anything", a=bool),
        struct_of(ours, a=inner),
        struct_of(ours, a=bool | int),
        struct_of(ours, **{f"f{number}": bool for number in range(6000)}),
        struct_of("p::msg::dds_::T\n_", a=bool),
    ):
        with pytest.raises(AmberboxError):
            schema_of_type(wrong)


@dataclass
class Recursive(IdlStruct, typename="p::msg::dds_::Recursive_"):
    again: "Recursive"  # noqa: UP037 - names itself


def test_a_type_in_itself_ends() -> None:
    assert schema_of_type(Recursive).data == b"p/msg/Recursive again\n"


@given(
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 5), st.integers(0, 3)), max_size=40),
    st.integers(0, 10**6),
)
def test_never_more_is_missing_than_was_lost_and_all_of_it_in_the_end(
    steps: list[tuple[int, int, int]], first: int
) -> None:
    """Steps: messages that arrive, messages lost, and messages that arrive amid a count."""
    numbers, number, taken, lost, reported = Numbers(), first, 0, 0, 0
    numbers.missing(number, taken, taken)
    for arrived, gone, amid in steps:
        number, taken, lost = number + arrived + gone, taken + arrived, lost + gone
        reported += numbers.missing(number + amid // 2, taken, taken + amid)
        number, taken = number + amid, taken + amid
        assert reported <= lost
    reported += numbers.missing(number, taken, taken)
    assert reported == lost


def test_messages_of_before_do_not_count_as_found_again() -> None:
    numbers = Numbers()
    assert numbers.missing(100, 0, 0) == 0
    assert numbers.missing(100, 10, 10) == 0  # the last ten, which the publisher had kept
    assert numbers.missing(103, 11, 11) == 2


def test_a_package_of_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda _: "12.0.0")
    with pytest.raises(AmberboxError, match=r"cyclonedds 12\.0\.0") as caught:
        cyclone.require_cyclonedds()
    assert "amberbox[ros2-dds]" in caught.value.hint


def test_a_wrong_interface_is_named() -> None:
    with pytest.raises(AmberboxError, match="cannot open domain 9") as caught:
        cyclone.Participant(9, cyclone.configuration("nowhere0", (), False, 1000))
    assert "interface" in caught.value.hint


@pytest.mark.parametrize("text", ['"/><evil', "a&b", "x>y"])
def test_names_cannot_change_the_configuration(text: str) -> None:
    from xml.etree import ElementTree

    tree = ElementTree.fromstring(cyclone.configuration(text, (text,), True, 1000))
    assert [one.get("Address") for one in tree.iter("Peer")] == [text]
    assert [one.get("name") for one in tree.iter("NetworkInterface")] == [text]


@pytest.mark.parametrize(
    "keys",
    [
        {"via": "bridge", "url": "wss://robot:8765"},
        {"via": "zenoh", "endpoint": "tls/robot:7447"},
        {"via": "dds", "domain": 5},
        {"via": "dds", "domain": 5, "interface": "eth1", "multicast": False},
        {"via": "dds", "domain": 0, "peers": ["10.0.0.2", "fe80::1"]},
    ],
)
def test_an_address_says_what_a_block_says(keys: dict[str, Any]) -> None:
    address = ros2.service_of(ros2.Config(**keys, all_topics=True), "/talker")
    assert address is not None and address[0] == "ros2_node"
    assert ros2.keys_of(address[1].partition("@")[2]) == keys


@pytest.mark.parametrize(
    "keys",
    [
        {"via": "bridge", "authority": "ca.pem"},
        {"via": "zenoh", "domain": 7},
        {"via": "zenoh", "zenoh_config": "z.json5"},
        {"via": "dds", "hosts": {"robot": "10.0.0.2"}},
    ],
)
def test_no_probe_is_named_where_its_address_would_not_say_all(keys: dict[str, Any]) -> None:
    assert ros2.service_of(ros2.Config(**keys, all_topics=True), "/talker") is None
