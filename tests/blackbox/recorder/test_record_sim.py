"""A simulated robot recorded as fast as the machine can: the same seed gives the same record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.columns.arrays import compact
from amberbox.blackbox.recorder.recorder import Recorder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import ColumnData, Ragged
from amberbox.sim.robot import START_NS
from tests.support.manual_recorder import last_counters

TOPICS = (
    "[{topic: {name: odom}}, {topic: {name: scan_rear, max_frequency: 5}}, {topic: {name: wheels}}]"
)


def record(folder: Path, seed: int, more: str = "") -> Path:
    folder.mkdir()
    (folder / "black_box.yaml").write_text(
        f"- sim:\n    seed: {seed}\n    speed: max\n    duration_s: 20\n"
        f"    topics: {TOPICS}\n{more}"
    )
    Recorder(load_folder(folder), retention=False).run()
    return folder / "store"


def values(column: ColumnData) -> Any:
    if isinstance(column, Ragged):
        lists = compact(column)
        return lists.offsets.tolist(), values(lists.values)
    return column.tolist() if column.dtype == object else column.tobytes()


def content(store: Path) -> dict[str, Any]:
    record = amberbox.open(store)
    names = [item.name for item in record.items() if item.source == "sim" and "__" not in item.name]
    tables = {}
    for name in names:
        columns = [column.name for column in record.variables(name).columns]
        table = record.query(name, [*columns, "received"])
        tables[name] = {column: values(table[column]) for column in table.names}
    return tables


def test_the_same_seed_gives_the_same_rows(tmp_path: Path) -> None:
    one = content(record(tmp_path / "one", 5))
    assert set(one) == {"sim_odom", "sim_scan_rear", "sim_wheels"}
    assert one == content(record(tmp_path / "two", 5))
    assert one["sim_odom"] != content(record(tmp_path / "three", 6))["sim_odom"]


def test_times_are_the_robots_own(tmp_path: Path) -> None:
    store = record(tmp_path / "robot", 5)
    items = {item.name: item for item in amberbox.open(store).items()}
    odom, scan = items["sim_odom"], items["sim_scan_rear"]
    assert START_NS <= odom.first_ns < START_NS + NS
    assert START_NS + 19 * NS < odom.last_ns <= START_NS + 20 * NS
    assert odom.rate_hz == pytest.approx(50, rel=0.02)
    counters = last_counters(store)
    assert scan.rate_hz is not None and scan.rate_hz < 5.6
    assert counters["sim_scan_rear"]["rate_limited"] > 80
    assert counters["sim_odom"]["kept"] == odom.rows
    assert all(item.first_ns >= START_NS for item in items.values())


def test_virtual_time_goes_with_nothing_else(tmp_path: Path) -> None:
    live = "- zmq:\n    endpoint: tcp://127.0.0.1:1\n    topics: []\n"
    with pytest.raises(UsageError, match="virtual time"):
        record(tmp_path / "robot", 5, live)
