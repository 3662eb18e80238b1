"""Unrolling messages into columns, side by side with rosbags reading and flattening them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec
import numpy as np
from foxglove import messages as fox

from amberbox.blackbox.columns import Unroller
from amberbox.blackbox.columns.frame_layout import FrameField, FrameLayout, FrameUnroller
from amberbox.blackbox.columns.json_messages import widen_schema
from amberbox.blackbox.columns.protobuf_messages import ProtobufUnroller
from amberbox.blackbox.columns.ros_messages import RosUnroller
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic
from benchmarks.common import Row, rate
from benchmarks.mix import START_NS, make_message, store

BATCH = 100
BATCHES = 20
TARGETS = {"Odometry": "to be > 1 M and >= 20 times", "Imu": "to be > 1 M and >= 20 times"}
TYPES = (
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/Pose",
    "sensor_msgs/msg/LaserScan",
    "diagnostic_msgs/msg/DiagnosticArray",
)


PROTOBUF_WAYS = {
    "PoseInFrame": (("by layout", BATCH), ("by layout", 10 * BATCH), ("one by one", BATCH)),
    "LaserScan": (("one by one", BATCH), ("one by one", 10 * BATCH)),
}


def measure() -> list[Row]:
    """Measure rows per CPU second, by layout and with the decoder for many layouts."""
    ros = [row for name in TYPES for cdr in (False, True) for row in _of_type(name, cdr)]
    return [*ros, *_of_protobuf(), *_of_frames(), *_of_json()]


def _of_type(name: str, cdr: bool) -> Iterator[Row]:
    types = store()
    rng = np.random.default_rng(1)
    write = types.serialize_cdr if cdr else types.serialize_ros1
    read = types.deserialize_cdr if cdr else types.deserialize_ros1
    count = BATCH * (BATCHES if "Diagnostic" not in name else 2)
    made = (make_message(types, name, k, START_NS + k * 10**7, rng) for k in range(count))
    messages = [bytes(write(message, name)) for message in made]
    text, _ = types.generate_msgdef(name, ros_version=2 if cdr else 1)
    schema = Schema(name, "ros2msg" if cdr else "ros1msg", text.encode())
    peer = rate(count, lambda: [flatten(read(message, name)) for message in messages], 3)
    kind, wire = name.rpartition("/")[2], "CDR" if cdr else "ROS 1"
    for way, by_layout in (("by layout", True), ("one by one", False)):
        unroll = RosUnroller(schema, cdr, by_layout=by_layout)
        value = rate(count, _in_batches(unroll, messages))
        what = f"{kind}, {wire}, {len(unroll.schema.columns)} columns, {way}"
        note = TARGETS.get(kind, "") if by_layout else "for topics of many layouts"
        yield Row(what, value, "rows/s", f"rosbags + flatten {peer:,.0f}", value / peer, note)


def _in_batches(
    unroll: Unroller, messages: Sequence[bytes], size: int = BATCH
) -> Callable[[], None]:
    batches = [messages[start : start + size] for start in range(0, len(messages), size)]

    def all_batches() -> None:
        for batch in batches:
            unroll.rows(batch)

    return all_batches


def flatten(message: Any) -> dict[str, Any]:
    """Flatten an object of rosbags into one dictionary, fixed arrays up to 64 unrolled."""
    flat: dict[str, Any] = {}
    _flatten(message, "", flat)
    return flat


def _flatten(value: Any, name: str, flat: dict[str, Any]) -> None:
    if isinstance(value, float | int | str):
        flat[name] = value
    elif hasattr(value, "__msgtype__"):
        for key, inner in vars(value).items():
            _flatten(inner, f"{name}_{key}" if name else key, flat)
    elif isinstance(value, np.ndarray) and len(value) <= 64:
        for index, item in enumerate(value.tolist()):
            flat[f"{name}_{index}"] = item
    elif isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
        for index, item in enumerate(value):
            _flatten(item, f"{name}_{index}", flat)
    else:
        flat[name] = value


def _of_protobuf() -> Iterator[Row]:
    rng = np.random.default_rng(1)
    identity = fox.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    made: dict[str, list[fox.PoseInFrame | fox.LaserScan]] = {name: [] for name in PROTOBUF_WAYS}
    for k in range(BATCH * BATCHES):
        stamp = fox.Timestamp(START_NS // NS + k, int(rng.integers(NS)))
        pose = fox.Pose(position=fox.Vector3(x=k * 0.1, y=1.0, z=0.0), orientation=identity)
        made["PoseInFrame"].append(fox.PoseInFrame(timestamp=stamp, frame_id="map", pose=pose))
        ranges = rng.random(720).tolist()
        made["LaserScan"].append(fox.LaserScan(timestamp=stamp, frame_id="laser", ranges=ranges))
    for name, messages in made.items():
        known = messages[0].get_schema()
        schema = Schema(known.name, known.encoding, known.data)
        data = [message.encode() for message in messages]
        for way, size in PROTOBUF_WAYS[name]:
            unroll = ProtobufUnroller(schema, by_layout=way == "by layout")
            what = f"{name}, protobuf, {len(unroll.schema.columns)} columns, {way}"
            value = rate(len(data), _in_batches(unroll, data, size))
            yield Row(what, value, "rows/s", note=f"batches of {size:,}")


def _of_frames() -> Iterator[Row]:
    rng = np.random.default_rng(1)
    fields = tuple(
        FrameField(f"axis/{n}/{name}", 64 * n + bit, bits, "int", scale=scale)
        for n in range(4)
        for name, bit, bits, scale in (("position", 0, 32, 1e-4), ("speed", 32, 20, 0.01))
    )
    frames = [rng.bytes(32) for _ in range(BATCH * BATCHES)]
    unroll = FrameUnroller(FrameLayout(fields, 32).to_schema("drives"))
    value = rate(len(frames), _in_batches(unroll, frames))
    yield Row(f"raw frames by layout, {len(fields)} columns", value, "rows/s")


def _of_json() -> Iterator[Row]:
    rng = np.random.default_rng(1)
    messages = [
        msgspec.json.encode(
            {
                "header": {"timestamp": START_NS / 1e9 + k, "type": "WHEEL"},
                "wheels": [
                    {"velocity": v, "current": 1.5, "ok": True} for v in rng.random(4).tolist()
                ],
                "pose": {"x": k * 0.1, "y": 1.0, "theta": 0.0},
            }
        )
        for k in range(BATCH * BATCHES)
    ]
    schema, _ = widen_schema(None, messages[:1], "json", "wheel")
    what = "JSON with a child table of 4"
    checked = rate(len(messages), lambda: widen_schema(schema, messages, "json", "wheel"))
    yield Row(f"{what}, schema unchanged", checked, "messages/s")
    task = unroller(Topic("/wheel", "json", schema))
    yield Row(f"{what}, rows", rate(len(messages), _in_batches(task, messages)), "rows/s")
