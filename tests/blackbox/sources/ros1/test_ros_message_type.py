"""ROS 1 messages from and to JSON values: as rosbags reads them, wrong values, hostile bytes."""

from __future__ import annotations

import base64
import math
import struct
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.columns.ros1_text import standard_names
from amberbox.blackbox.sources.ros1 import message_type as module
from amberbox.blackbox.sources.ros1.master import RosError, TcprosError
from amberbox.blackbox.sources.ros1.message_type import (
    UNGIVEN,
    MessageType,
    action_type,
    message_type,
    service_type,
)
from amberbox.core.errors import UsageError
from tests.fuzzing import examples, fuzz

EVERYTHING = """
bool flag
int8 i8
uint8 u8
byte octet
char letter
int16 i16
uint16 u16
int32 i32
uint32 u32
int64 i64
uint64 u64
float32 f32
float64 f64
string text
time at
duration lasting
float64[3] three
int16[] many
uint8[] blob
bool[] flags
string[] names
geometry_msgs/Point[] points
geometry_msgs/Point[2] pair
std_msgs/Empty nothing
"""


@pytest.fixture(scope="module")
def everything() -> MessageType:
    return message_type("my_msgs/Everything", EVERYTHING)


def test_every_standard_type_has_a_default_that_rosbags_reads() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in standard_names():
        kind = message_type(name)
        data = kind.encode({})
        store.deserialize_ros1(data, name.replace("/", "/msg/"))
        assert kind.encode(kind.decode(data)) == data
        assert kind.md5sum == store.generate_msgdef(name.replace("/", "/msg/"))[1]


def test_values_are_where_rosbags_reads_them() -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    data = message_type("nav_msgs/Odometry").encode(
        {
            "header": {"stamp": 1.5, "frame_id": "odom"},
            "child_frame_id": "bäse",
            "pose": {"pose": {"position": {"x": -2}}, "covariance": [n / 2 for n in range(36)]},
        }
    )
    read: Any = store.deserialize_ros1(data, "nav_msgs/msg/Odometry")
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1, 500_000_000)
    assert (read.header.frame_id, read.child_frame_id) == ("odom", "bäse")
    assert read.pose.pose.position.x == -2.0
    assert list(read.pose.covariance) == [n / 2 for n in range(36)]


def integers(bits: int, signed: bool = True) -> st.SearchStrategy[int]:
    low = -(2 ** (bits - 1)) if signed else 0
    return st.integers(low, 2 ** (bits - 1) - 1 if signed else 2**bits - 1)


FLOATS = st.floats(allow_nan=False)
POINTS = st.fixed_dictionaries({"x": FLOATS, "y": FLOATS, "z": FLOATS})
VALUES = st.fixed_dictionaries(
    {
        "flag": st.booleans(), "i8": integers(8), "u8": integers(8, False), "octet": integers(8),
        "letter": integers(8, False), "i16": integers(16), "u16": integers(16, False),
        "i32": integers(32), "u32": integers(32, False), "i64": integers(64),
        "u64": integers(64, False), "f32": st.floats(allow_nan=False, width=32), "f64": FLOATS,
        "text": st.text(st.characters(exclude_categories=["Cs"])),
        "at": st.fixed_dictionaries(
            {"secs": integers(32, False), "nsecs": st.integers(0, 10**9 - 1)}
        ),
        "lasting": st.fixed_dictionaries(
            {"secs": integers(32), "nsecs": st.integers(0, 10**9 - 1)}
        ),
        "three": st.lists(FLOATS, min_size=3, max_size=3), "many": st.lists(integers(16)),
        "blob": st.binary().map(lambda data: base64.b64encode(data).decode()),
        "flags": st.lists(st.booleans()),
        "names": st.lists(st.text(st.characters(exclude_categories=["Cs"]))),
        "points": st.lists(POINTS, max_size=3), "pair": st.lists(POINTS, min_size=2, max_size=2),
        "nothing": st.just({}),
    }
)  # fmt: skip


@given(VALUES)
def test_what_is_encoded_is_decoded(everything: MessageType, value: dict[str, Any]) -> None:
    assert everything.decode(everything.encode(value)) == value


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ({"flagg": True}, "flagg is no field of my_msgs/Everything; did you mean 'flag'"),
        ({"flag": 1}, "flag must be true or false, not 1"),
        ({"i8": 128}, r"i8 must be between -128 and 127 \(int8\), not 128"),
        ({"octet": 128}, r"octet must be between -128 and 127"),
        ({"letter": -1}, r"letter must be between 0 and 255"),
        ({"u64": 2**64}, "u64 must be between 0 and 18446744073709551615"),
        ({"i32": 1.5}, "i32 must be a whole number"),
        ({"i32": True}, "i32 must be a number, not True"),
        ({"i32": math.nan}, "i32 must be a whole number"),
        ({"f64": "fast"}, "f64 must be a number, not 'fast'"),
        ({"f32": 1e39}, r"f32 is too large for float32"),
        ({"f64": 10**400}, "f64 is too large for float64"),
        ({"f64": 10**5000}, "f64 is too large for float64: an endless number"),
        ({"text": 3}, "text must be a text, not 3"),
        ({"text": "\ud800"}, "text holds half a character"),
        ({"at": -1}, "at must be between 0 and 4294967295 seconds"),
        ({"at": "soon"}, "at must be seconds, 'now' or {secs: , nsecs: }, not 'soon'"),
        ({"at": {"sec": 1}}, "at must be seconds"),
        ({"at": {"secs": 1, "nsecs": 10**9}}, "at must be seconds"),
        ({"at": math.inf}, "at must be seconds"),
        ({"lasting": "now"}, "lasting must be seconds or"),
        ({"three": [1, 2]}, "three must have 3 values, not 2"),
        ({"three": 7}, "three must be a list, not 7"),
        ({"many": {"0": 1}}, "many must be a list, not a mapping"),
        ({"many": "12"}, "many must be a list, not '12'"),
        ({"many": [1, "2"]}, "many/1 must be a number, not '2'"),
        ({"blob": "?"}, "blob must be a list of numbers or their bytes as base64"),
        ({"points": [{}, {"w": 1}]}, "points/1/w is no field of geometry_msgs/Point"),
        ({"nothing": 1}, "nothing must have the fields of std_msgs/Empty, 1 has none"),
    ],
)
def test_wrong_values(everything: MessageType, value: dict[str, Any], what: str) -> None:
    with pytest.raises(UsageError, match=what):
        everything.encode(value)


def test_all_problems_come_at_once(everything: MessageType) -> None:
    with pytest.raises(UsageError, match=r"flag must.*i8 must.*names/0 must"):
        everything.encode({"flag": 1, "i8": 1000, "names": [1]})
    with pytest.raises(UsageError, match="and more"):
        everything.encode({"names": list(range(1000))})


def test_other_forms_of_values(everything: MessageType) -> None:
    value = {"at": "now", "lasting": -0.5, "i32": 2.0, "blob": [1, 255], "f64": 3, "text": UNGIVEN}
    read = everything.decode(everything.encode(value, now_ns=7_000_000_001))
    assert read["at"] == {"secs": 7, "nsecs": 1}
    assert read["lasting"] == {"secs": -1, "nsecs": 500_000_000}
    assert (read["i32"], read["f64"], read["text"]) == (2, 3.0, "")
    assert base64.b64decode(read["blob"]) == b"\x01\xff"


def test_a_message_that_would_fill_the_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    huge = message_type("a/Huge", "float64[2000000000] values")
    with pytest.raises(UsageError, match="more than 16777216 bytes"):
        huge.encode({})
    empties = message_type("a/Empties", "std_msgs/Empty[2000000000] values")
    with pytest.raises(UsageError, match="more than 1048576 values"):
        empties.encode({})
    with pytest.raises(TcprosError, match="more than 1048576 values"):
        empties.decode(b"")
    levels = "".join(f"{'=' * 80}\nMSG: a/T{n}\nT{n + 1}[9] x\n" for n in range(20))
    nested = message_type("a/Nested", f"T0[9] x\n{levels}{'=' * 80}\nMSG: a/T20\n")
    with pytest.raises(TcprosError, match="more than 1048576 values"):
        nested.decode(b"")
    monkeypatch.setattr(module, "MOST_BYTES", 100)
    with pytest.raises(UsageError, match="more than 100 bytes"):
        message_type("std_msgs/String").encode({"data": "a" * 200})


@pytest.mark.parametrize(
    ("name", "data", "what"),
    [
        ("std_msgs/String", b"\xff\xff\xff\xff", "it ends 4294967295 bytes too early"),
        ("std_msgs/String", b"\x01", "does not fit"),
        ("std_msgs/String", b"\0\0\0\0x", "1 bytes left"),
        ("nav_msgs/Path", bytes(16) + b"\xff\xff\xff\xff", "values"),
        ("sensor_msgs/LaserScan", b"", "does not fit"),
        ("std_msgs/Float64MultiArray", bytes(8) + b"\xff\xff\xff\x7f", "too early"),
    ],
)
def test_messages_with_wrong_lengths(name: str, data: bytes, what: str) -> None:
    with pytest.raises(TcprosError, match=what):
        message_type(name).decode(data)


@fuzz
@settings(max_examples=examples(300))
@given(st.binary(max_size=400))
def test_random_bytes_are_a_message_or_an_error(everything: MessageType, data: bytes) -> None:
    with suppress(RosError):
        assert everything.decode(data)


@fuzz
@settings(max_examples=examples(200))
@given(st.text(max_size=300))
def test_random_definitions_are_types_or_errors(text: str) -> None:
    with suppress(UsageError):
        assert message_type("a/B", text or "#").md5sum


@pytest.mark.parametrize("name", ["Twist", "a/b/C", "/a/B", "../etc/x", "a/B\n", "", "a//B", "1/B"])
def test_names_that_are_no_types(name: str) -> None:
    with pytest.raises(UsageError, match="is not the name of a type"):
        message_type(name)


def test_unknown_types_and_unreadable_definitions() -> None:
    with pytest.raises(UsageError, match="did you mean 'geometry_msgs/Twist'"):
        message_type("geometry_msgs/Twst")
    for text in ("float64", "no_msgs/Nothing x", "B inside", "wstring x", "x" * 300_000):
        with pytest.raises(UsageError):
            message_type("a/B", text).encode({})
    chain = "".join(f"{'=' * 80}\nMSG: a/T{n}\nT{n + 1} x\n" for n in range(3000))
    with pytest.raises(UsageError):
        message_type("a/B", f"T0 x\n{chain}{'=' * 80}\nMSG: a/T3000\nint8 z\n")


def test_services() -> None:
    known = service_type("std_srvs/SetBool")
    assert known.md5sum == "09fb03525b03e7ea1fd3992bafd87e16"
    assert known.request.encode({"data": True}) == b"\1"
    assert known.response.decode(b"\0" + struct.pack("<I", 2) + b"no") == {
        "success": False, "message": "no",
    }  # fmt: skip
    given = service_type("std_srvs/SetBool", "bool data\n---  \nbool success\nstring message\n")
    assert given.md5sum == known.md5sum
    with pytest.raises(UsageError, match="did you mean 'std_srvs/Trigger'"):
        service_type("std_srvs/Triger")
    with pytest.raises(UsageError, match="has 3 parts, not 2"):
        service_type("a/B", "---\n---\n")


def test_actions() -> None:
    standard = action_type("actionlib/TestAction")
    given = action_type(
        "actionlib/TestAction", "int32 goal\n---\nint32 result\n---\nint32 feedback"
    )
    for part in ("goal", "result", "feedback"):
        assert getattr(given, part).md5sum == getattr(standard, part).md5sum
    move_base = action_type("move_base_msgs/MoveBaseAction")
    assert move_base.goal.md5sum == "660d6895a1b9a16dce51fbdd9a64a56b"  # as in its package
    for name, text in (
        ("a/B", ""),
        ("a/BAction", ""),
        ("a/BAction", "---"),
        ("aAction", "---\n---"),
    ):
        with pytest.raises(UsageError):
            action_type(name, text)
