"""Import: messages per second of each format, from the file to journal and columns."""

from __future__ import annotations

import itertools
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.formats._recording import ReadOptions
from amberbox.blackbox.query.importing import import_recordings
from amberbox.core.clock import NS
from benchmarks.common import Row, cpu_s

START_NS = 1_790_000_000 * NS
PERIOD_NS = NS // 100
ODOMETRY = "nav_msgs/Odometry"
COUNT = 20_000
ROWS = 60_000
_POSES = struct.Struct("<7d")


@dataclass(frozen=True)
class _Input:
    """A recording to import, and how many messages it holds."""

    name: str
    count: int
    write: Callable[[Path], Path]
    options: ReadOptions = ReadOptions()  # noqa: RUF009  # frozen, so it can be shared
    note: str = ""


def measure() -> list[Row]:
    """Measure each format on data made for it."""
    return list(itertools.chain.from_iterable(map(_measure, _inputs())))


def _inputs() -> list[_Input]:
    odometry = "odometry of 725 bytes, 100 Hz"
    return [
        _Input("ROS 1 bag", COUNT, _write_bag, note=odometry),
        _Input("MCAP", COUNT, _write_mcap, note=odometry),
        _Input("MCAP with JSON", COUNT, _write_json, note="13 numbers in 3 structures"),
        _Input("mongodump, typed", COUNT, _write_dump, note=odometry),
        _Input("mongodump, inferred", COUNT, _write_unknown, note="the same without its type"),
        _Input("ULog", ROWS, _write_ulog, note="an IMU of 33 bytes"),
        _Input("CSV", ROWS, _write_csv, note="a time and 10 columns"),
    ]


def _measure(given: _Input) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = given.write(Path(folder))
        stores = (Path(folder) / f"store{n}" for n in itertools.count())

        def work(segments: bool) -> None:
            (report,) = import_recordings(
                [path], next(stores), segments=segments, options=given.options
            )
            assert report.messages == given.count and not report.damage

        for segments, what in ((False, "to the journal"), (True, "to journal and Parquet")):
            rate = given.count / cpu_s(lambda segments=segments: work(segments), 3)  # type: ignore[misc]  # a default argument binds it
            yield Row(f"{given.name} {what}", rate, "messages/s CPU", note=given.note)


# -- what is imported


def _values() -> NDArray[Any]:
    random = np.random.default_rng(1)
    return np.cumsum(random.normal(0, 0.01, (COUNT, 13)), axis=0)


def _times_ns(count: int) -> list[int]:
    return [START_NS + n * PERIOD_NS for n in range(count)]


def _messages() -> Iterator[tuple[int, bytes]]:
    """Make odometry as it is on the wire."""
    covariance = bytes(8 * 36)
    for at_ns, values in zip(_times_ns(COUNT), _values().tolist(), strict=True):
        head = struct.pack("<III", 7, *divmod(at_ns, NS))
        frames = b"\4\0\0\0odom" + b"\x09\0\0\0base_link"
        pose, twist = struct.pack("<7d", *values[:7]), struct.pack("<6d", *values[7:])
        yield at_ns, head + frames + pose + covariance + twist + covariance


def _write_bag(folder: Path) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    path = folder / "odometry.bag"
    types = get_typestore(Stores.ROS1_NOETIC)
    with Writer(path) as writer:
        connection = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=types)
        for at_ns, data in _messages():
            writer.write(connection, at_ns, data)
    return path


def _write_mcap(folder: Path) -> Path:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    definition, _ = types.generate_msgdef("nav_msgs/msg/Odometry", ros_version=1)
    schema = (ODOMETRY, "ros1msg", str(definition).encode())
    return _mcap(folder / "odometry.mcap", schema, "ros1", _messages())


def _write_json(folder: Path) -> Path:
    import msgspec

    rows = (
        (at_ns, msgspec.json.encode(_document(values)))
        for at_ns, values in zip(_times_ns(COUNT), _values().tolist(), strict=True)
    )
    schema = ("odometry", "jsonschema", b'{"type": "object"}')
    return _mcap(folder / "json.mcap", schema, "json", rows)


def _mcap(
    path: Path, schema: tuple[str, str, bytes], encoding: str, rows: Iterator[tuple[int, bytes]]
) -> Path:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="benchmark")
        number = writer.register_schema(*schema)
        channel = writer.register_channel("/odom", encoding, number)
        for at_ns, data in rows:
            writer.add_message(channel, at_ns, data, at_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped
    return path


def _document(values: list[float]) -> dict[str, Any]:
    x, y, z, qx, qy, qz, qw, *rest = values
    linear, angular = (dict(zip("xyz", part, strict=True)) for part in (rest[:3], rest[3:]))
    position = {"x": x, "y": y, "z": z}
    orientation = {"x": qx, "y": qy, "z": qz, "w": qw}
    return {
        "pose": {"position": position, "orientation": orientation},
        "twist": {"linear": linear, "angular": angular},
    }


def _write_dump(folder: Path, kind: str = ODOMETRY) -> Path:
    import bson

    dump = folder / "dump"
    dump.mkdir()
    described = {"collection_name": "ros_odom", "ros": {"topic_name": "/odom", "msg_type": kind}}
    (dump / "black_box_metadata.bson").write_bytes(bson.encode(described))
    with (dump / "ros_odom.bson").open("wb") as file:
        for at_ns, values in zip(_times_ns(COUNT), _values().tolist(), strict=True):
            parts = _document(values)
            covariance = [0.0] * 36
            stamp = dict(zip(("secs", "nsecs"), divmod(at_ns, NS), strict=True))
            document = {
                "_id": bson.ObjectId(),
                "header": {"seq": 7, "stamp": stamp, "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {"pose": parts["pose"], "covariance": covariance},
                "twist": {"twist": parts["twist"], "covariance": covariance},
                "timestamp": at_ns / NS,
            }
            file.write(bson.encode(document))
    return dump


def _write_unknown(folder: Path) -> Path:
    return _write_dump(folder, "nobody_msgs/Odometry")


def _write_ulog(folder: Path) -> Path:
    path = folder / "flight.ulg"
    fields = "uint64_t timestamp;float[3] gyro;float[3] accel;bool clipped"
    log = [b"ULog\x01\x12\x35\x01" + bytes(8), _record("F", f"imu:{fields};".encode())]
    log.append(_record("A", b"\0\0\0imu"))
    log += [
        _record("D", struct.pack("<HQ6f?", 0, n * 4000, *[n / 7] * 6, n % 2)) for n in range(ROWS)
    ]
    path.write_bytes(b"".join(log))
    return path


def _record(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def _write_csv(folder: Path) -> Path:
    path = folder / "table.csv"
    random = np.random.default_rng(1)
    values = np.cumsum(random.normal(0, 0.01, (ROWS, 8)), axis=0).tolist()
    with path.open("w") as file:
        file.write("timestamp,count,state,a,b,c,d,e,f,g,h\n")
        for n, row in enumerate(values):
            at = f"{START_NS // NS + n // 100}.{n % 100:02d}"
            numbers = ",".join(map(repr, row))
            file.write(f"{at},{n},{'driving' if n % 900 else 'waiting'},{numbers}\n")
    return path
