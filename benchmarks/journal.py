"""Raw messages from memory to disk: our journal beside other writers of robot data."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.blackbox.journal.writer import JournalOptions, JournalWriter
from benchmarks import mix
from benchmarks.common import Row, cpu_s

SECONDS = 100
WRITES_PER_SYNC = 10
FULL_SPEED_WRITE = 40_000
"""Messages of one write at full speed: 0.1 s of 400,000 messages/s."""
ROBOT_WRITE = 42
"""Messages of one write at the robot's own pace: 0.1 s of 421 messages/s."""


def measure() -> list[Row]:
    """Measure CPU time per message, index, hash chain and syncs of ours included."""
    data = mix.make(SECONDS)
    count = len(data.messages)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        peers = {
            "foxglove-sdk (Rust), zstd": lambda: write_foxglove(data, place / "foxglove.mcap"),
            "mcap (Python), zstd": lambda: write_mcap(data, place / "python.mcap"),
            "rosbags, rosbag2 mcap": lambda: write_rosbags(data, place / "rosbags"),
            "decode, flatten, BSON": lambda: encode_bson(data),
        }
        rates = {name: count / cpu_s(work, 3) for name, work in peers.items()}
        ours = Ours(data)
        full = count / cpu_s(lambda: ours.write(place, FULL_SPEED_WRITE), 3)
        slow = count / cpu_s(lambda: ours.write(place, ROBOT_WRITE), 3)
        size = sum(path.stat().st_size for path in ours.last.glob("*.mcap"))
    rows = [
        Row("journal at full speed, write_s 0.1", full, "messages/s", name, full / rate)
        for name, rate in rates.items()
    ]
    rust = rates["foxglove-sdk (Rust), zstd"]
    note = f"{ROBOT_WRITE} messages per chunk, {size / count:.0f} bytes per message"
    rows.append(Row("journal, chunks as a robot fills them", slow, "messages/s",
                    "foxglove-sdk (Rust), zstd", slow / rust, note))  # fmt: skip
    return rows + [Row(name, rate, "messages/s") for name, rate in rates.items()]


class Ours:
    """Our journal; each run writes into a folder of its own."""

    def __init__(self, data: mix.Mix) -> None:
        self.data = data
        self.numbers = np.array(data.numbers, np.uint16)
        self.times = np.array(data.times_ns)
        self.runs = 0
        self.last = Path()

    def write(self, place: Path, per_write: int) -> None:
        """Write the mix in portions, with a sync after every tenth."""
        self.runs += 1
        self.last = place / f"ours-{self.runs}"
        writer = JournalWriter(JournalOptions(self.last, "0" * 8, "main", 1, "0" * 8))
        for topic in self.data.topics:
            writer.channel(topic, {"item": topic.name})
        for portion, start in enumerate(range(0, len(self.data.messages), per_write)):
            part = slice(start, start + per_write)
            if writer.rotation_due(int(self.times[start])):
                writer.rotate()
            times = self.times[part]
            writer.write(self.numbers[part], times, times, self.data.messages[part])
            if portion % WRITES_PER_SYNC == WRITES_PER_SYNC - 1:
                writer.mark_sync().wait()
        writer.close()


def write_foxglove(data: mix.Mix, path: Path) -> None:
    """Write with the Rust writer as it comes."""
    import foxglove
    from foxglove import Channel, Context, Schema
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    path.unlink(missing_ok=True)
    context = Context()
    options = MCAPWriteOptions(compression=MCAPCompression.Zstd)
    writer = foxglove.open_mcap(str(path), context=context, writer_options=options)
    logs: list[Callable[..., Any]] = []
    for topic in data.topics:
        assert topic.schema is not None
        schema = Schema(name=topic.schema.name, encoding="ros1msg", data=topic.schema.data)
        logs.append(
            Channel(topic.name, schema=schema, message_encoding="ros1", context=context).log
        )
    for number, time_ns, message in zip(data.numbers, data.times_ns, data.messages, strict=True):
        logs[number](message, log_time=time_ns)
    writer.close()


def write_mcap(data: mix.Mix, path: Path) -> None:
    """Write with MCAP's Python writer as it comes."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = []
        for topic in data.topics:
            assert topic.schema is not None
            schema = writer.register_schema(topic.schema.name, "ros1msg", topic.schema.data)
            channels.append(writer.register_channel(topic.name, "ros1", schema))
        for number, time_ns, message in zip(
            data.numbers, data.times_ns, data.messages, strict=True
        ):
            writer.add_message(channels[number], time_ns, message, time_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped


def write_rosbags(data: mix.Mix, path: Path) -> None:
    """Write a ROS 2 bag in MCAP storage with rosbags, without compression as it comes."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    shutil.rmtree(path, ignore_errors=True)
    types = mix.store()
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = [
            writer.add_connection(topic.name, name, typestore=types)
            for topic, name in zip(data.topics, mix.RATES_HZ, strict=True)
        ]
        for number, time_ns, message in zip(
            data.numbers, data.times_ns, data.messages, strict=True
        ):
            writer.write(connections[number], time_ns, message)


def encode_bson(data: mix.Mix) -> None:
    """Do per message what a document store asks of its client: decode, flatten, BSON."""
    import bson

    types, names = mix.store(), list(mix.RATES_HZ)
    for number, time_ns, message in zip(data.numbers, data.times_ns, data.messages, strict=True):
        flat: dict[str, Any] = {"timestamp": time_ns / 1e9}
        flatten(types.deserialize_ros1(message, names[number]), "", flat)
        bson.encode(flat)


def flatten(value: Any, path: str, into: dict[str, Any]) -> None:
    """Put the fields of a decoded message under flat names."""
    if hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            if name != "__msgtype__":
                flatten(getattr(value, name), f"{path}/{name}" if path else name, into)
    elif isinstance(value, np.ndarray):
        into[path] = value.tolist()
    elif isinstance(value, list):
        for place, entry in enumerate(value):
            flatten(entry, f"{path}/{place}", into)
    else:
        into[path] = value
