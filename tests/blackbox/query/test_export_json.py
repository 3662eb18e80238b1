"""MCAP with flat columns as JSON: what viewers plot, and back into a store."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

import amberbox
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportReport, View
from amberbox.core.types import Ragged
from amberbox.testing.records import T0_NS, FakeItem, FakeRun, build_segments_of, fill_store
from tests.blackbox.query.conftest import Kind, item_like, record_robot


def run(store: Path, target: Path, **view: Any) -> ExportReport:
    return export(amberbox.open(store), View(**view), target, "mcap-json")


def rows(path: Path, topic: str) -> list[dict[str, Any]]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages(topic)
        return [json.loads(message.data, parse_constant=refuse) for _, _, message in found]


def schema_of(path: Path, topic: str) -> dict[str, Any]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channel = next(c for c in summary.channels.values() if c.topic == topic)
    found: dict[str, Any] = json.loads(summary.schemas[channel.schema_id].data)
    return found


def test_a_channel_per_table_in_order_of_receipt(tmp_path: Path) -> None:
    fill_store(tmp_path / "store")
    build_segments_of(tmp_path / "store", 1)
    report = run(tmp_path / "store", tmp_path / "out.mcap")
    assert report.counts == {"battery": 30, "odom": 300, "odom__units": 300}
    with (tmp_path / "out.mcap").open("rb") as file:
        found = [
            (c.topic, m.log_time, m.publish_time)
            for _, c, m in make_reader(file).iter_messages(log_time_order=False)
        ]
    times = [log_ns for _, log_ns, _ in found]
    assert times == sorted(times) and len(times) == 630
    odom = amberbox.open(tmp_path / "store").query("odom", ["received", "timestamp"])
    assert [t for topic, t, _ in found if topic == "odom"] == odom.values("received")
    assert [t for topic, _, t in found if topic == "odom"] == odom.values("timestamp")


def test_values_are_flat_and_schemas_say_what_they_are(tmp_path: Path) -> None:
    record_robot(tmp_path / "store", seconds=1).close()
    run(tmp_path / "store", tmp_path / "out.mcap", items=["ros_range"])
    first = rows(tmp_path / "out.mcap", "ros_range")[0]
    stamp = amberbox.open(tmp_path / "store").query("ros_range").values("timestamp")[0]
    assert first["timestamp"] == {"sec": stamp // 10**9, "nsec": stamp % 10**9}
    assert (first["header_stamp"], first["header_frame_id"]) == (stamp, "base_link")
    assert (first["field_of_view"], first["range"]) == (0.5, 0.0)
    schema = schema_of(tmp_path / "out.mcap", "ros_range")
    assert (schema["title"], schema["type"]) == ("ros_range", "object")
    kinds = {name: part["type"] for name, part in schema["properties"].items()}
    assert list(kinds) == list(first)
    assert (kinds["range"], kinds["header_stamp"], kinds["header_frame_id"]) == (
        "number", "integer", "string",
    )  # fmt: skip


def test_what_json_does_not_have(tmp_path: Path) -> None:
    """NaN and infinities are null, also in lists; a missing value has no key."""
    box = record_robot(tmp_path / "store", seconds=0)
    kind = Kind("std_msgs/msg/Float64MultiArray")
    layout = kind.types.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    box.hear(kind.topic("/list"), kind.encode(layout, np.array([1.5, np.nan, np.inf, -np.inf])))
    number = Kind("std_msgs/msg/Float32")
    for value in (0.1, np.nan, np.inf):
        box.hear(number.topic("/number"), number.encode(np.float32(value)))
    box.write()
    box.close()
    record = FakeRun(tmp_path / "store")
    item = FakeItem("some", [{"a": 1, "b": 2.5}])
    record.write([(T0_NS, item, {"a": 1}), (T0_NS + 1, item, {"b": 2.0})])
    record.close()
    run(tmp_path / "store", tmp_path / "out.mcap")
    assert rows(tmp_path / "out.mcap", "ros_list")[0]["data"] == [1.5, None, None, None]
    numbers = [row["data"] for row in rows(tmp_path / "out.mcap", "ros_number")]
    assert numbers == [float(np.float32(0.1)), None, None]
    first, second = rows(tmp_path / "out.mcap", "some")
    assert (first["a"], second["b"]) == (1, 2.0)
    assert "b" not in first and "a" not in second


def test_binary_and_large_numbers(tmp_path: Path) -> None:
    box = record_robot(tmp_path / "store", seconds=0)
    kind = Kind("sensor_msgs/msg/CompressedImage")
    box.hear(
        kind.topic("/image"), kind.encode(kind.header(T0_NS), "png", np.arange(200, dtype=np.uint8))
    )
    large = Kind("std_msgs/msg/UInt64")
    box.hear(large.topic("/large"), large.encode(2**64 - 1))
    box.write()
    box.close()
    run(tmp_path / "store", tmp_path / "out.mcap")
    assert rows(tmp_path / "out.mcap", "ros_image")[0]["data"].startswith("AAECAwQF")
    assert rows(tmp_path / "out.mcap", "ros_large")[0]["data"] == 2**64 - 1
    part = schema_of(tmp_path / "out.mcap", "ros_image")["properties"]["data"]
    assert part == {"type": "string", "contentEncoding": "base64"}


def test_columns_come_back_equal(tmp_path: Path) -> None:
    record_robot(tmp_path / "store", cdr=True).close()
    fill_store(tmp_path / "store")
    run(tmp_path / "store", tmp_path / "out.mcap", received=True)
    before, after = amberbox.open(tmp_path / "store"), amberbox.open(tmp_path / "out.mcap")
    for item in ("ros_text", "ros_range", "odom", "odom__units", "battery"):
        again = item_like(after, item)
        names = [
            "timestamp",
            *(c.name for c in before.variables(item).columns if c.name != "index"),
        ]
        one, other = before.query(item, [*names, "received"]), after.query(again)
        for name in names:
            assert plain(one[name]) == plain(other[name]), (item, name)
        assert one.values("received") == after.query(again, ["received"]).values("received")


def plain(column: Any) -> list[Any]:
    if isinstance(column, Ragged):
        return [column[row].tolist() for row in range(len(column))]
    listed: list[Any] = column.tolist()
    return listed
