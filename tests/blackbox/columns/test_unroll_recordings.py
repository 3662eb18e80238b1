"""Whole recordings against rosbags: every message, every column, both decoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.columns import diagnostic_values
from amberbox.blackbox.columns.ros_messages import RosUnroller
from amberbox.core.types import ColumnData, ItemSchema, Ragged, Rows, Schema

NS = 1_000_000_000
TYPES = get_typestore(Stores.ROS1_NOETIC)
BATCH = 400


def topics(path: Path) -> Iterator[tuple[Schema, bool, list[bytes], list[Any]]]:
    """Read a recording topic by topic: schema, whether CDR, messages, and rosbags' objects."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        for connection in reader.connections:
            raw = [bytes(data) for _, _, data in reader.messages([connection])]
            read = [reader.deserialize(data, connection.msgtype) for data in raw]
            text = connection.msgdef.data
            if not text:
                text, _ = store.generate_msgdef(connection.msgtype, ros_version=2)
            encoding = "ros2msg" if reader.is2 else "ros1msg"
            yield Schema(connection.msgtype, encoding, text.encode()), reader.is2, raw, read


def getter(path: str) -> Callable[[Any], Any]:
    parts = [int(part) if part.isdigit() else part for part in path.split("/")]

    def get(message: Any) -> Any:
        for part in parts:
            message = message[part] if isinstance(part, int) else getattr(message, part)
        return message

    return get


def check_columns(rows: Rows, schema: ItemSchema, messages: Sequence[Any]) -> int:
    """Compare a table with rosbags' objects; return the number of values compared."""
    assert rows.count == len(messages)
    compared = 0
    for column in schema.columns:
        expected = list(map(getter(column.path), messages))
        check_column(rows.columns[column.name], column.type, expected)
        compared += len(expected)
    for path, child in schema.children.items():
        if path == diagnostic_values.PATH:  # no part of the message
            continue
        lists = list(map(getter(path), messages))
        table = rows.children[path]
        parents = np.repeat(np.arange(len(lists)), [len(items) for items in lists])
        assert table.parent_row is not None and np.array_equal(table.parent_row, parents)
        compared += check_columns(table, child, [item for items in lists for item in items])
    return compared


def check_column(data: ColumnData, kind: str, expected: list[Any]) -> None:
    if isinstance(data, Ragged):
        assert np.array_equal(np.diff(data.offsets), [len(row) for row in expected])
        expected = [item for row in expected for item in row]
        data, kind = data.values, kind[5:-1]
    if kind in ("time", "duration"):
        expected = [item.sec * NS + item.nanosec for item in expected]
    if kind == "binary":
        expected = [item.tobytes() for item in expected]
    if kind in ("string", "binary"):
        assert data.tolist() == expected
    else:
        np.testing.assert_array_equal(data, np.array(expected, data.dtype))


def check_recording(path: Path) -> int:
    compared = 0
    for schema, cdr, raw, read in topics(path):
        for by_layout in (True, False):
            unroller = RosUnroller(schema, cdr, by_layout=by_layout)
            for start in range(0, len(raw), BATCH):
                rows = unroller.rows(raw[start : start + BATCH])
                compared += check_columns(rows, unroller.schema, read[start : start + BATCH])
                check_stamps(unroller, rows, raw[start : start + BATCH])
    return compared


def check_stamps(unroller: RosUnroller, rows: Rows, raw: Sequence[bytes]) -> None:
    if rows.stamp_ns is None:
        assert unroller.stamp_ns(raw[0]) is None
    else:
        assert rows.stamp_ns[:5].tolist() == [unroller.stamp_ns(m) or 0 for m in raw[:5]]


@pytest.mark.needs_data
@pytest.mark.parametrize(
    "name",
    [
        "plotjuggler_tilt_laser.bag",
        "plotjuggler_fake_joint_state.bag",
        "plotjuggler_rosbag2_test",
        "imu_ardrone.bag",
        "rosbagjs_example-lz4.bag",
    ],
)
def test_recordings_unroll_as_rosbags_reads_them(shared_data: Path, name: str) -> None:
    assert check_recording(shared_data / "recordings" / name) > 10_000


def test_a_generated_recording_unrolls_as_rosbags_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "robot.bag"
    with Writer(path) as bag:
        for name, make in MESSAGES.items():
            connection = bag.add_connection(f"/{name}", name, typestore=TYPES)
            for turn in range(30):
                bag.write(connection, turn, TYPES.serialize_ros1(make(turn), name))
    assert check_recording(path) > 10_000


def make(kind: str, /, **fields: Any) -> Any:
    return TYPES.types[kind](**fields)


def header(turn: int) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=turn, nanosec=7)
    return make(
        "std_msgs/msg/Header", seq=turn, stamp=stamp, frame_id="base" if turn % 5 else "map"
    )


def xyz(name: str, value: float, **more: float) -> Any:
    return make(f"geometry_msgs/msg/{name}", x=value, y=-value, z=np.inf, **more)


def pose(turn: int) -> Any:
    position, orientation = xyz("Point", turn), xyz("Quaternion", turn / 7, w=1.0)
    return make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def odometry(turn: int) -> Any:
    twist = make("geometry_msgs/msg/Twist", linear=xyz("Vector3", 1), angular=xyz("Vector3", turn))
    spread = np.arange(36.0) + turn
    with_spread = "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/msg/TwistWithCovariance"
    return make(
        "nav_msgs/msg/Odometry",
        header=header(turn),
        child_frame_id="wheel",
        pose=make(with_spread[0], pose=pose(turn), covariance=spread),
        twist=make(with_spread[1], twist=twist, covariance=spread),
    )


def joints(turn: int) -> Any:
    values = np.arange(12.0) * turn
    names = [f"joint_{number}" for number in range(12)]
    return make(
        "sensor_msgs/msg/JointState",
        header=header(turn),
        name=names,
        position=values,
        velocity=values[: turn % 3],
        effort=values[:0],
    )


def diagnostics(turn: int) -> Any:
    kind = "diagnostic_msgs/msg/DiagnosticStatus"
    pairs = [
        make("diagnostic_msgs/msg/KeyValue", key=f"k{number}", value="ü" * number)
        for number in range(turn % 4)
    ]
    status = [
        make(kind, level=turn % 3, name=f"n{part}", message="", hardware_id="h", values=pairs)
        for part in range(turn % 5)
    ]
    return make("diagnostic_msgs/msg/DiagnosticArray", header=header(turn), status=status)


def image(turn: int) -> Any:
    return make(
        "sensor_msgs/msg/Image",
        header=header(turn),
        height=2,
        width=turn,
        encoding="mono8",
        is_bigendian=0,
        step=turn,
        data=np.arange(2 * turn, dtype=np.uint8),
    )


def poses(turn: int) -> Any:
    return make(
        "geometry_msgs/msg/PoseArray", header=header(turn), poses=[pose(i) for i in range(turn)]
    )


MESSAGES: dict[str, Callable[[int], Any]] = {
    "nav_msgs/msg/Odometry": odometry,
    "sensor_msgs/msg/JointState": joints,
    "diagnostic_msgs/msg/DiagnosticArray": diagnostics,
    "sensor_msgs/msg/Image": image,
    "geometry_msgs/msg/PoseArray": poses,
}
