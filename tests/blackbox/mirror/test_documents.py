"""Rows as documents of a ROPOD black box: the paper's pose, ids of positions, nested sequences."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import bson
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns.ros_definition import parse_definition
from amberbox.blackbox.formats.mongodump import MessageTypes, compile_encoder, content_of
from amberbox.blackbox.mirror.documents import Layout, documents, id_bytes, metadata, slices_of
from amberbox.blackbox.mirror.mongodb import MongoMirror, MongoTarget
from amberbox.blackbox.store.batches import BatchOrigin, ItemStream, make_batch
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.types import Batch, Position, Schema, Topic
from tests.blackbox.columns.test_unroll_ros import Type, reference, same, typed_messages
from tests.support.manual_recorder import ManualBox


def ros(name: str, kind: str) -> Topic:
    found = MessageTypes().find(kind)
    assert found is not None
    return Topic(name, "ros1", found.schema)


def recorded(store: Path, topic: Topic, *messages: bytes, source: str = "ros") -> Batch:
    box = ManualBox(store, source=source)
    box.hear(topic, *messages)
    box.write()
    box.close()
    name = f"{source}_{topic.name.strip('/').replace('/', '_')}"
    (batch,) = (d for d in follow(store, [name], live=False) if isinstance(d, Batch))
    return batch


POSE = struct.pack("<7d", 1.0, -2.0, 0.5, 0.0, 0.0, 0.6, math.nan)


def test_the_paper_s_pose_has_eight_fields(tmp_path: Path) -> None:
    batch = recorded(tmp_path, ros("/pose", "geometry_msgs/Pose"), POSE)
    (document,) = documents(batch, "flat")
    received_ns = int(batch.received_ns[0])
    assert math.isnan(document.pop("orientation/w"))
    assert document == {
        "timestamp": received_ns / NS, "position/x": 1.0, "position/y": -2.0, "position/z": 0.5,
        "orientation/x": 0.0, "orientation/y": 0.0, "orientation/z": 0.6,
    }  # fmt: skip
    assert metadata(batch) == {
        "collection_name": "ros_pose",
        "ros": {"topic_name": "/pose", "msg_type": "geometry_msgs/Pose",
                "direct_msg_mapping": True},
    }  # fmt: skip


def test_nested_documents_are_as_those_of_the_ropod_robots(tmp_path: Path) -> None:
    text = struct.pack("<I", 3)
    header = struct.pack("<III", 7, 1_544_441_408, 70_478_099) + struct.pack("<I", 0)
    status = b"\2" + text + b"arm" + text + b"hot" + struct.pack("<I", 0)
    key = struct.pack("<I", 1) + b"k" + struct.pack("<I", 1)
    two = struct.pack("<I", 2) + key + b"1" + key + b"2"
    none = struct.pack("<I", 0)
    messages = [
        header + struct.pack("<I", 2) + status + two + status + none,
        header + none,
        header + struct.pack("<I", 1) + status + struct.pack("<I", 1) + key + b"3",
    ]
    topic = ros("/diagnostics", "diagnostic_msgs/DiagnosticArray")
    batch = recorded(tmp_path, topic, *messages)
    for most in (1, 2, 500):
        found = [d for part in slices_of(batch, most) for d in documents(part)]
        assert [len(document["status"]) for document in found] == [2, 0, 1]
        assert found[0].keys() == {"header", "status", "timestamp"}
        assert found[0]["header"] == {
            "seq": 7, "stamp": {"secs": 1_544_441_408, "nsecs": 70_478_099}, "frame_id": "",
        }  # fmt: skip
        first = found[0]["status"][0]
        assert first == {
            "level": 2, "name": "arm", "message": "hot", "hardware_id": "",
            "values": [{"key": "k", "value": "1"}, {"key": "k", "value": "2"}],
        }  # fmt: skip
        assert found[0]["status"][1]["values"] == []
        assert found[2]["status"][0]["values"] == [{"key": "k", "value": "3"}]


def test_what_a_message_lacks_is_left_out_and_its_own_timestamp_is_kept(tmp_path: Path) -> None:
    schema = Schema(
        "reading", "jsonschema",
        b'{"type": "object", "properties": {"timestamp": {"type": "number"}, '
        b'"a": {"type": "object", "properties": {"x": {"type": "integer"}}}}}',
    )  # fmt: skip
    batch = recorded(
        tmp_path, Topic("reading", "json", schema), b'{"timestamp": 5, "a": {"x": 1}}',
        b'{"a": {}}', source="zmq",
    )  # fmt: skip
    first, second = documents(batch)
    assert first["message_timestamp"] == 5 and first["a"] == {"x": 1}
    assert "message_timestamp" not in second and second["timestamp"] > 1e9
    assert metadata(batch)["zmq"]["topic_name"] == "reading"


def test_ids_follow_from_the_position() -> None:
    place = Position("store", "main", 3, 17)
    one = id_bytes(place, 1_700_000_000 * NS + 5)
    assert one == id_bytes(place, 1_700_000_000 * NS + 5) and len(one) == 12
    assert bson.ObjectId(one).generation_time.timestamp() == 1_700_000_000
    others = [place._replace(run=4), place._replace(seq=18), place._replace(writer="bulk")]
    assert len({one, *(id_bytes(other, 1_700_000_000 * NS) for other in others)}) == 4


@pytest.mark.parametrize("layout", ["nested", "flat"])
def test_numbers_beyond_those_of_bson_are_decimals(tmp_path: Path, layout: Layout) -> None:
    topic = Topic("/big", "ros1", Schema("x/Big", "ros1msg", b"uint64 data\n"))
    batch = recorded(tmp_path, topic, struct.pack("<Q", 2**64 - 1), struct.pack("<Q", 5))
    found: list[dict[str, Any]] = documents(batch, layout)
    assert [str(document["data"]) for document in found] == [str(2**64 - 1), "5"]
    assert bson.decode(bson.encode(found[0]))["data"].to_decimal() == 2**64 - 1


def test_the_password_is_in_no_text() -> None:
    target = MongoTarget("mongodb://127.0.0.1:1", "logs", "box", "s3cret")
    assert "s3cret" not in repr(target)
    MongoMirror(target, "store").close()


@given(typed_messages(), st.sampled_from(["nested", "flat"]), st.integers(1, 5))
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
def test_any_message_of_ros_1_can_be_made_of_its_document(
    drawn: tuple[Type, list[Any]], layout: Layout, most: int
) -> None:
    kind, messages = drawn
    data = [kind.serialize(message, cdr=False) for message in messages]
    if not data:
        return
    topic = Topic("/any", "ros1", kind.schema())
    origin = BatchOrigin("main", 1, ItemStream("ros_any", topic, "ros"), ClockTable([(0, 0)]))
    times = np.arange(len(data)) + NS
    batch = make_batch(origin, np.arange(len(data)) * 3, times, data).batch
    assert batch is not None
    encode = compile_encoder(parse_definition(kind.schema()))
    found = [
        encode(content_of(bson.decode(bson.encode(document))))
        for part in slices_of(batch, most)
        for document in documents(part, layout)
    ]
    again = [kind.deserialize(one, cdr=False) for one in found]
    assert same(reference(kind, again), reference(kind, messages))
