"""A record as ROS 1 and ROS 2 robots make it, for the tests of export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from amberbox.blackbox.query.record import Record
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.store import segment_builder
from amberbox.blackbox.store.journal_reader import journals
from amberbox.core.types import Schema, Topic
from amberbox.testing.records import build_segments_of, fill_store
from tests.support.manual_recorder import ManualBox

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True)
class Kind:
    """A message type of one ROS version."""

    name: str
    cdr: bool = False
    latched: bool = False

    @property
    def types(self) -> Any:
        return ROS2 if self.cdr else ROS1

    def topic(self, name: str) -> Topic:
        version = 2 if self.cdr else 1
        text, _ = self.types.generate_msgdef(self.name, ros_version=version)
        schema = Schema(self.name if self.cdr else self.name.replace("/msg/", "/"),
                        f"ros{version}msg", text.encode())  # fmt: skip
        return Topic(name, "cdr" if self.cdr else "ros1", schema, self.latched)

    def encode(self, *values: Any) -> bytes:
        message = self.types.types[self.name](*values)
        write = self.types.serialize_cdr if self.cdr else self.types.serialize_ros1
        return bytes(write(message, self.name))

    def header(self, at_ns: int, frame: str = "base_link") -> Any:
        time = self.types.types["builtin_interfaces/msg/Time"](*divmod(at_ns, 10**9))
        sequence = () if self.cdr else (7,)
        return self.types.types["std_msgs/msg/Header"](*sequence, time, frame)


def record_robot(
    store: Path, *, cdr: bool = False, seconds: int = 3, rotate_s: float = 600
) -> ManualBox:
    """Record text at 10 Hz, a range every third write, and a latched map name at the start."""
    box = ManualBox(store, options=PipelineOptions(rotate_ns=round(rotate_s * 1e9)))
    text, scan = Kind("std_msgs/msg/String", cdr), Kind("sensor_msgs/msg/Range", cdr)
    name = Kind("std_msgs/msg/String", cdr, latched=True)
    box.hear(name.topic("/map_name"), name.encode("hall"))
    for number in range(10 * seconds):
        box.hear(text.topic("/text"), text.encode(f"message {number}"))
        if number % 3 == 0:
            header = scan.header(box.sink.now_ns() - 5_000_000)
            values = (np.float32(0.5), np.float32(0.1), np.float32(4), np.float32(number / 4))
            box.hear(scan.topic("/range"), scan.encode(header, 1, *values))
        box.write()
    return box


STORES = ("journals", "one segment", "segments", "joined", "raw gone", "no pyarrow")
"""How the rows of a store may lie."""


def filled_as(kind: str, path: Path, patch: pytest.MonkeyPatch, reader: ModuleType) -> Path:
    """Fill a store whose rows lie as ``STORES`` names it; without pyarrow ``reader`` has none."""
    fill_store(path)
    if kind == "no pyarrow":
        build_segments_of(path)
        patch.setattr(reader, "can_build", lambda: False)
    elif kind != "journals":
        build_segments_of(path, 1 if kind == "one segment" else None)
    if kind == "joined":
        patch.setattr(segment_builder, "MERGE_COUNT", 2)
        assert segment_builder.merge_small(path)
    if kind == "raw gone":
        for journal in [journal for journal in journals(path) if journal.finished]:
            journal.path.unlink()
    return path


def item_like(record: Record, item: str) -> str:
    """Find an item that was exported and imported again, whatever its source is then."""
    names = [info.name for info in record.items() if info.name.endswith(item)]
    return min(names, key=len)


@pytest.fixture
def ros1_store(tmp_path: Path) -> Path:
    record_robot(tmp_path / "store").close()
    return tmp_path / "store"


@pytest.fixture
def ros2_store(tmp_path: Path) -> Path:
    record_robot(tmp_path / "store", cdr=True).close()
    return tmp_path / "store"
