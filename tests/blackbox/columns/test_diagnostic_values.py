"""The values of DiagnosticArray messages by name and key, beside the tables of its definition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns.unroll import unroller
from amberbox.core.types import ColumnData, Ragged, Schema, Topic

KIND = "diagnostic_msgs/msg/DiagnosticArray"
STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "cdr": get_typestore(Stores.ROS2_HUMBLE)}


def array(store: Any, *status: tuple[str, int, dict[str, str]]) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=0)
    head = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    return types[KIND](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="", **head),
        status=[
            types["diagnostic_msgs/msg/DiagnosticStatus"](
                level=level, name=name, message="", hardware_id=f"id of {name}",
                values=[
                    types["diagnostic_msgs/msg/KeyValue"](key=key, value=value)
                    for key, value in pairs.items()
                ],
            )
            for name, level, pairs in status
        ],
    )  # fmt: skip


def plain(column: ColumnData) -> NDArray[Any]:
    assert not isinstance(column, Ragged)
    return column


MESSAGES: list[list[tuple[str, int, dict[str, str]]]] = [
    [("motor", 1, {"temperature": "71.5", "state": "hot"}), ("disk", 0, {})],
    [],
    [("empty", 0, {}), ("disk", 2, {"free": " 3e2 ", "odd": "1_000", "none": "", "limit": "-inf"})],
]


@pytest.mark.parametrize("encoding", ["ros1", "cdr"])
def test_each_status_and_key_is_one_row(encoding: str) -> None:
    store = STORES[encoding]
    text, _ = store.generate_msgdef(KIND, ros_version=1 if encoding == "ros1" else 2)
    name = KIND if encoding == "cdr" else KIND.replace("/msg/", "/")
    schema = Schema(name, "ros1msg" if encoding == "ros1" else "ros2msg", text.encode())
    write = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    unroll = unroller(Topic("/diagnostics", encoding, schema))
    rows = unroll.rows([bytes(write(array(store, *status), KIND)) for status in MESSAGES])

    table = rows.children["by_key"]
    columns = {name: np.ma.filled(plain(c), np.nan).tolist() for name, c in table.columns.items()}
    assert list(columns) == [column.name for column in unroll.schema.children["by_key"].columns]
    names = ["motor", "motor", "disk", "disk", "disk", "disk"]
    assert columns["name"] == names
    assert columns["hardware_id"] == [f"id of {name}" for name in names]
    assert columns["level"] == [1, 1, 2, 2, 2, 2]
    assert columns["key"] == ["temperature", "state", "free", "odd", "none", "limit"]
    assert columns["value"] == ["71.5", "hot", " 3e2 ", "1_000", "", "-inf"]
    np.testing.assert_equal(columns["number"], [71.5, np.nan, 300.0, np.nan, np.nan, -np.inf])
    assert np.ma.getmaskarray(plain(table.columns["number"])).tolist() == [0, 1, 0, 1, 1, 0]
    assert table.parent_row is not None and table.parent_row.tolist() == [0, 0, 2, 2, 2, 2]
    assert table.index is not None and table.index.tolist() == [0, 1, 0, 1, 2, 3]
    labels = {column.name: column.labels for column in unroll.schema.children["by_key"].columns}
    assert labels["level"][2] == "ERROR"
    assert list(unroll.schema.children) == ["status", "by_key"]


def test_another_type_of_that_name_keeps_its_own_tables() -> None:
    schema = Schema("diagnostic_msgs/DiagnosticArray", "ros1msg", b"uint8[] status\nint8 level\n")
    assert not unroller(Topic("/diagnostics", "ros1", schema)).schema.children


def test_the_table_is_found_in_a_recording(tmp_path: Path) -> None:
    store = STORES["ros1"]
    with Writer(tmp_path / "d.bag") as writer:
        connection = writer.add_connection("/diagnostics", KIND, typestore=store)
        for number, status in enumerate(MESSAGES):
            data = store.serialize_ros1(array(store, *status), KIND)
            writer.write(connection, 1_700_000_000_000_000_000 + number, data)
    with amberbox.open(tmp_path / "d.bag") as record:
        table = record.query("ros_diagnostics__by_key", ["parent_seq", "index", "key", "number"])
        assert {info.name: info.rows for info in record.items() if "diag" in info.name} == {
            "ros_diagnostics": 3,
            "ros_diagnostics__status": 4,
            "ros_diagnostics__status__values": 6,
            "ros_diagnostics__by_key": 6,
        }
    assert plain(table["key"]).tolist() == ["temperature", "state", "free", "odd", "none", "limit"]
    assert plain(table["index"]).tolist() == [0, 1, 0, 1, 2, 3]
