"""Unrolling of single message types: names, columns, labels, stamps, and what ROS leaves open."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from amberbox.blackbox.columns import UnrollError
from amberbox.blackbox.columns.layout_cache import MOST_LAYOUTS
from amberbox.blackbox.columns.ros_messages import RosUnroller
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Ragged, Rows, Schema, Topic

SEPARATOR = "=" * 80 + "\n"
POINT = SEPARATOR + "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
POSE = (
    "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    + POINT
    + SEPARATOR
    + "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
)
HEADER = SEPARATOR + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
HEADER2 = (
    SEPARATOR + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    "" + SEPARATOR + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
NS = 1_000_000_000


def ros1(text: str, name: str = "p/T", stamp: str | None = None) -> RosUnroller:
    return RosUnroller(Schema(name, "ros1msg", text.encode()), cdr=False, stamp=stamp)


def cdr(text: str, name: str = "p/msg/T", encoding: str = "ros2msg") -> RosUnroller:
    return RosUnroller(Schema(name, encoding, text.encode()), cdr=True)


def values(rows: Rows, name: str) -> list[Any]:
    column = rows.columns[name]
    assert not isinstance(column, Ragged)
    return list(column)


def test_a_pose_is_the_seven_columns_of_the_paper() -> None:
    topic = Topic("/pose", "ros1", Schema("geometry_msgs/Pose", "ros1msg", POSE.encode()))
    pose = unroller(topic)
    rows = pose.rows([struct.pack("<7d", *range(7)), struct.pack("<7d", *range(10, 17))])
    assert [column.name for column in pose.schema.columns] == [
        "position_x",
        "position_y",
        "position_z",
        "orientation_x",
        "orientation_y",
        "orientation_z",
        "orientation_w",
    ]
    assert values(rows, "orientation_w") == [6.0, 16.0]
    assert rows.children == {} and rows.stamp_ns is None
    assert pose.schema.columns[0].unit == "m" and pose.schema.columns[3].unit == ""


def test_fixed_arrays_unroll_up_to_64_and_are_lists_beyond() -> None:
    text = "float32[64] a\nfloat32[65] b\nuint8[64] c\nuint8[65] d\nuint8[] e\nbyte[] f\nint8[] g\n"
    kinds = {column.path: column.type for column in ros1(text).schema.columns}
    assert [path for path in kinds if path.startswith("a/")] == [f"a/{i}" for i in range(64)]
    assert kinds["b"] == "list<float32>" and kinds["c/63"] == "uint8"
    assert [kinds[path] for path in "defg"] == ["binary", "binary", "binary", "list<int8>"]


def test_arrays_of_structures_unroll_by_index_and_long_ones_become_child_tables() -> None:
    sensor = SEPARATOR + "MSG: p/Sensor\nfloat64 velocity\nuint8[2] raw\n"
    short = ros1("p/Sensor[4] sensors\n" + sensor).schema
    assert short.columns[3].name == "sensors_1_velocity"
    assert short.columns[3].path == "sensors/1/velocity"
    long = ros1("p/Sensor[65] sensors\n" + sensor).schema
    assert long.columns == () and list(long.children) == ["sensors"]
    assert [column.name for column in long.children["sensors"].columns] == [
        "velocity",
        "raw_0",
        "raw_1",
    ]


def test_an_array_that_would_make_thousands_of_columns_becomes_a_child_table() -> None:
    inner = SEPARATOR + "MSG: p/Inner\nfloat64[64] a\nfloat64[64] b\n"
    assert len(ros1("p/Inner[32] x\n" + inner).schema.columns) == 4096
    assert list(ros1("p/Inner[33] x\n" + inner).schema.children) == ["x"]


def test_grandchildren_point_to_the_row_above() -> None:
    leaf = SEPARATOR + "MSG: p/Leaf\nint8 v\n"
    nested = ros1("p/Mid[] mids\n" + SEPARATOR + "MSG: p/Mid\np/Leaf[] leaves\n" + leaf)
    one = struct.pack("<II2bIb", 2, 2, 1, 2, 1, 3)
    none = struct.pack("<I", 0)
    rows = nested.rows([one, none, one])
    mids, leaves = rows.children["mids"], rows.children["mids"].children["leaves"]
    assert mids.parent_row is not None and leaves.parent_row is not None
    assert mids.parent_row.tolist() == [0, 0, 2, 2]
    assert leaves.parent_row.tolist() == [0, 0, 1, 2, 2, 3]
    assert leaves.index is not None and leaves.index.tolist() == [0, 1, 0, 0, 1, 0]
    assert values(leaves, "v") == [1, 2, 3, 1, 2, 3]


@pytest.mark.parametrize("count", [0, 1, 3])
def test_empty_messages_have_rows_but_no_columns(count: int) -> None:
    assert ros1("").rows([b""] * count).count == count
    padded = b"\0\1\0\0" + b"\0\0\0\0"
    assert cdr("").rows([padded] * count).count == count
    named = cdr("uint8 structure_needs_at_least_one_member\n")
    assert named.schema.columns == () and named.rows([padded] * count).count == count
    with pytest.raises(UnrollError):
        ros1("").rows([b"x"])


def test_an_empty_sequence_of_doubles_adds_no_padding() -> None:
    text = "float64[] a\nint32 b\nfloat64[] c\n"
    empty = b"\0\1\0\0" + struct.pack("<IiI", 0, 7, 0)
    full = b"\0\1\0\0" + struct.pack("<I4xdiId", 1, 0.5, 8, 1, 1.5)
    rows = cdr(text).rows([empty, full])
    assert values(rows, "b") == [7, 8]
    lists = rows.columns["c"]
    assert isinstance(lists, Ragged) and [list(row) for row in (lists[0], lists[1])] == [[], [1.5]]


def test_big_endian_cdr_reads_as_little_endian_does() -> None:
    text = "uint16 a\nfloat64 b\nstring c\nwstring d\nint32[] e\ntime t\n"
    rows = []
    for order, mark in (("<", 1), (">", 0)):
        wide = "ü𝄞".encode("utf-16-le")
        units = struct.unpack("<3H", wide)
        body = struct.pack(f"{order}H6xdI3s", 1, 2.5, 3, b"ab\0")
        body += struct.pack(f"{order}xI3I", 3, *units)
        body += struct.pack(f"{order}I2i", 2, -1, 5) + struct.pack(f"{order}iI", 3, 4)
        rows.append(cdr(text).rows([bytes([0, mark, 0, 0]) + body]))
    for read in rows:
        values = {name: data[0] for name, data in read.columns.items()}
        assert (values["a"], values["b"], values["c"], values["d"]) == (1, 2.5, "ab", "ü𝄞")
        assert values["e"].tolist() == [-1, 5] and values["t"] == 3 * NS + 4


@pytest.mark.parametrize("by_layout", [True, False])
@pytest.mark.parametrize("header", [b"\0\2\0\0", b"\0\7\0\0", b"\1\0\0\0", b"\0", b""])
def test_other_encapsulations_than_plain_cdr_are_misfits(header: bytes, by_layout: bool) -> None:
    number = RosUnroller(Schema("p/msg/T", "ros2msg", b"int32 a\n"), True, by_layout=by_layout)
    good = b"\0\1\0\0\5\0\0\0"
    with pytest.raises(UnrollError) as caught:
        number.rows([good, header + good[4:] * (len(header) > 3), good])
    assert caught.value.bad == (1,)


def test_strings_cdr() -> None:
    text = cdr("string s\n")
    good = b"\0\1\0\0" + struct.pack("<I3s", 3, b"hi\0")
    zero_length = b"\0\1\0\0" + struct.pack("<I", 0)
    assert values(text.rows([good, zero_length]), "s") == ["hi", ""]
    unterminated = b"\0\1\0\0" + struct.pack("<I3s", 3, b"hi!")
    with pytest.raises(UnrollError):
        text.rows([good, unterminated])


@pytest.mark.parametrize("by_layout", [True, False])
def test_invalid_utf8_is_replaced_alike(by_layout: bool) -> None:
    schema = Schema("p/T", "ros1msg", b"string s\n")
    text = RosUnroller(schema, False, by_layout=by_layout)
    batch = [struct.pack("<I2s", 2, data) for data in (b"a\xff", "ü".encode(), b"ab")]
    assert values(text.rows(batch), "s") == ["a\ufffd", "ü", "ab"]


def test_bytes_are_signed_in_ros_1_and_octets_in_ros_2() -> None:
    assert [c.type for c in ros1("byte a\nchar b\n").schema.columns] == ["int8", "uint8"]
    assert [c.type for c in cdr("byte a\nchar b\n").schema.columns] == ["uint8", "uint8"]


def test_bools_are_bools_whatever_the_byte() -> None:
    rows = ros1("bool a\nbool[2] b\nbool[] c\n").rows([b"\2\0\7\2\0\0\0\0\3"])
    assert rows.columns["a"][0] is np.True_ and rows.columns["b_1"][0] is np.True_
    lists = rows.columns["c"]
    assert isinstance(lists, Ragged) and lists.values.tolist() == [False, True]


def test_negative_durations() -> None:
    assert values(ros1("duration d\n").rows([struct.pack("<ii", -1, -5)]), "d") == [-NS - 5]
    later = struct.pack("<II", 2**32 - 1, 9)
    assert values(ros1("time t\n").rows([later]), "t") == [(2**32 - 1) * NS + 9]


def test_column_names_step_aside_for_ours() -> None:
    names = [c.name for c in ros1("int32 seq\nint32 a_b\np/N a\n" + N).schema.columns]
    assert names[1] == "a_b"
    assert names[0].startswith("seq_") and names[2].startswith("a_b_") and len(names[2]) == 8


N = SEPARATOR + "MSG: p/N\nint32 b\n"


def test_constants_label_the_fields_they_were_written_for() -> None:
    text = (
        "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_OTHER=0\nuint16 SERVICE_GPS=1\n"
        "int8 status\nuint16 service\nuint16 other\nfloat32 X=1.5\nfloat32 x\nstring S=a\n"
    )
    labels = {column.path: dict(column.labels) for column in ros1(text).schema.columns}
    assert labels["status"] == {-1: "STATUS_NO_FIX", 0: "STATUS_FIX"}
    assert labels["service"] == {1: "SERVICE_GPS"} and labels["other"] == {} == labels["x"]
    only = ros1("byte OK=0\nbyte WARN=1\nbyte level\nstring name\n").schema.columns[0]
    assert dict(only.labels) == {0: "OK", 1: "WARN"}
    assert not ros1("int32 A=1\nint32 b\nint32 c\n").schema.columns[0].labels


def test_definitions_that_rosbags_refuses_lose_only_their_labels() -> None:
    kept = ros1("uint8 A=1<<2\r\nuint8 A__B=2\r\nuint8 value # = 3\r\n")
    assert [column.path for column in kept.schema.columns] == ["value"]
    assert values(kept.rows([b"\7"]), "value") == [7]


def test_names_that_ros_1_allows_and_rosbags_does_not() -> None:
    text = "uint8 kRate=1\nuint8 A__B=2\nuint8 rate\nMyPkg/Old__Type x\n"
    kept = ros1(text + SEPARATOR + "MSG: MyPkg/Old__Type\nint8 a\n", "MyPkg/T_")
    assert [column.path for column in kept.schema.columns] == ["rate", "x/a"]
    assert dict(kept.schema.columns[0].labels) == {1: "kRate", 2: "A__B"}


@pytest.mark.parametrize("field", ["Header", "roslib/Header", "std_msgs/Header"])
@pytest.mark.parametrize("package", ["roslib", "std_msgs"])
def test_a_header_is_known_by_its_old_name(field: str, package: str) -> None:
    """Definitions of ROS before Diamondback use roslib/Header (REP 100)."""
    text = f"{field} header\nint32 x\n" + HEADER.replace("std_msgs", package)
    topic = ros1(text)
    assert topic.schema.stamp == "header/stamp"
    rows = topic.rows([struct.pack("<IIIIi", 1, 5, 6, 0, 9)])
    assert (values(rows, "header_stamp"), values(rows, "x")) == ([5 * NS + 6], [9])


def test_a_header_of_old_may_be_the_whole_message() -> None:
    root = ros1("uint32 seq\ntime stamp\nstring frame_id\n", "roslib/Header")
    assert (root.schema.type, root.schema.stamp) == ("roslib/Header", "stamp")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("p/Gone x\n", "p/msg/Gone is missing"),
        ("int32 ] x\n", "cannot read the definition of p/T"),
        ("p/T x\n", "contains itself"),
    ],
)
def test_definitions_that_cannot_be_unrolled_say_why(text: str, says: str) -> None:
    with pytest.raises(AmberboxError, match=says):
        ros1(text)


def test_idl_definitions() -> None:
    text = (
        SEPARATOR + "IDL: p/msg/T\nmodule p { module msg { struct T {\n"
        "builtin_interfaces::msg::Time stamp;\ndouble x[2];\nsequence<octet> raw;\n"
        "wstring name; }; }; };\n"
        + SEPARATOR
        + "IDL: builtin_interfaces/msg/Time\nmodule builtin_interfaces { module msg {\n"
        "struct Time { int32 sec; uint32 nanosec; }; }; };\n"
    )
    idl = cdr(text, encoding="ros2idl")
    assert [(c.name, c.type) for c in idl.schema.columns] == [
        ("stamp", "time"),
        ("x_0", "float64"),
        ("x_1", "float64"),
        ("raw", "binary"),
        ("name", "string"),
    ]
    message = b"\0\1\0\0" + struct.pack("<iIddI3sxII", 1, 2, 3.0, 4.0, 3, b"abc", 1, ord("z"))
    rows = idl.rows([message])
    assert rows.columns["raw"][0] == b"abc" and rows.columns["name"][0] == "z"
    assert idl.stamp_ns(message) == NS + 2


def test_own_stamp_of_header_and_its_zero() -> None:
    odom = ros1("Header header\nfloat64 x\n" + HEADER)
    messages = [struct.pack("<IIIId", 1, t, r, 0, 0.0) for t, r in ((7, 5), (0, 0))]
    assert odom.schema.stamp == "header/stamp"
    stamps = odom.rows(messages).stamp_ns
    assert stamps is not None and stamps.tolist() == [7 * NS + 5, 0]
    assert [odom.stamp_ns(message) for message in messages] == [7 * NS + 5, None]
    assert odom.stamp_ns(b"short") is None
    second = cdr("std_msgs/Header header\n" + HEADER2)
    message = b"\0\0\0\0" + struct.pack(">iIIx", 9, 8, 1)
    assert second.stamp_ns(message) == 9 * NS + 8


@pytest.mark.parametrize(
    ("text", "before"),
    [
        ("string name\ntime stamp\n", struct.pack("<I2s", 2, b"ab")),
        ("int8 a\nstring name\ntime stamp\n", struct.pack("<bI2s", 1, 2, b"ab")),
    ],
)
def test_own_stamp_behind_a_string(text: str, before: bytes) -> None:
    late = ros1(text)
    message = before + struct.pack("<II", 3, 4)
    assert late.schema.stamp == "stamp" and late.stamp_ns(message) == 3 * NS + 4
    assert late.stamp_ns(message[:-1]) is None


def test_the_configuration_may_name_another_stamp_or_none() -> None:
    text = "time a\nfloat64 seconds\ntime stamp\nduration d\n"
    message = struct.pack("<IIdIIii", 1, 0, 1.5e9, 2, 0, 0, 0)
    assert ros1(text).stamp_ns(message) == 2 * NS
    assert ros1(text, stamp="a").stamp_ns(message) == NS
    assert ros1(text, stamp="/seconds").stamp_ns(message) == 1_500_000_000 * NS
    none = ros1(text, stamp="")
    assert none.stamp_ns(message) is None and none.rows([message]).stamp_ns is None
    with pytest.raises(UsageError, match="no time stamp 'd'") as caught:
        ros1(text, stamp="d")
    assert caught.value.hint == "it has a, stamp"


def test_a_topic_with_many_layouts_switches_decoders_for_good() -> None:
    log = ros1("string s\n")
    for count in range(MOST_LAYOUTS + 3):
        texts = [chr(97 + length % 26) * length for length in range(count + 1)]
        batch = [struct.pack(f"<I{len(t)}s", len(t), t.encode()) for t in texts]
        assert values(log.rows(batch), "s") == texts
    assert log._layouts is None


def test_a_name_that_changes_now_and_then_keeps_the_layouts() -> None:
    odom = ros1("string s\nint32 n\n")
    for turn in range(40):
        text = "x" * turn
        message = struct.pack(f"<I{turn}si", turn, text.encode(), turn)
        rows = odom.rows([message] * 256)
        assert values(rows, "s") == [text] * 256 and values(rows, "n") == [turn] * 256
    assert odom._layouts is not None


def test_large_batches_are_joined_in_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amberbox.blackbox.columns.layout_cache._LARGEST_JOIN", 40)
    images = ros1("uint8[] data\nint32[] n\np/N[] c\n" + N)
    batch = [struct.pack(f"<I{i}sIiIi", i, b"x" * i, 1, i, 1, i) for i in range(12)]
    rows = images.rows(batch)
    assert values(rows, "data") == [b"x" * i for i in range(12)]
    assert [list(rows.columns["n"][i]) for i in range(12)] == [[i] for i in range(12)]
    child = rows.children["c"]
    assert child.parent_row is not None and child.parent_row.tolist() == list(range(12))
    with pytest.raises(UnrollError) as caught:
        images.rows([*batch, b"", *batch, b"?"])
    assert caught.value.bad == (12, 25)


def test_claimed_counts_are_not_believed() -> None:
    hollow = ros1("p/E[] e\np/E[] f\n" + SEPARATOR + "MSG: p/E\n")
    assert hollow.rows([struct.pack("<II", 3, 0)]).children["e"].count == 3
    with pytest.raises(UnrollError):
        hollow.rows([struct.pack("<II", 2**32 - 1, 0)])
    with pytest.raises(UnrollError):
        ros1("string[] s\n").rows([struct.pack("<I", 2**32 - 1)])
