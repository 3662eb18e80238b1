"""Queries: every row once and in order, from journals and segments alike, before and after."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amberbox
from amberbox.blackbox.query import record as query
from amberbox.blackbox.query.record import follow_tables
from amberbox.blackbox.query.rows import By
from amberbox.blackbox.store import segment_builder as segments
from amberbox.blackbox.store.journal_reader import journals
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.testing.records import (
    BATTERY,
    T0_NS,
    FakeItem,
    FakeRun,
    build_segments_of,
    pose,
)
from tests.blackbox.query.conftest import STORES, filled_as

MS = 1_000_000


@pytest.fixture(params=STORES)
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = filled_as(request.param, tmp_path / "store", monkeypatch, query)
    if request.param == "no pyarrow":
        monkeypatch.setitem(sys.modules, "pyarrow", None)
    return path


def test_every_row_comes_once_in_order(store: Path) -> None:
    table = amberbox.open(store).query("odom", ["x", "y", "mode", "seq", "received"])
    assert table.names == ["timestamp", "pose_x", "pose_y", "mode", "seq", "received"]
    number = np.arange(300)
    assert table.values("pose_x") == number.tolist()
    assert table.values("pose_y") == (-number / 4).tolist()
    assert table.values("mode") == ["A", "B"] * 150
    assert table.values("received") == (T0_NS + number * 10 * MS).tolist()
    assert table.values("timestamp") == (T0_NS + number * 10 * MS - 3 * MS).tolist()
    assert (np.diff(table.values("seq")) > 0).all()
    assert not table.notes


@pytest.mark.parametrize(
    ("from_", "to", "by", "expected"),
    [
        (T0_NS + 50 * 10 * MS, T0_NS + 120 * 10 * MS, "received", range(50, 120)),
        (T0_NS + 50 * 10 * MS + 1, None, "received", range(51, 300)),
        (None, T0_NS + 10 * MS, "received", range(1)),
        (T0_NS + 50 * 10 * MS - 3 * MS, T0_NS + 51 * 10 * MS, "timestamp", range(50, 52)),
        (T0_NS + 10_000 * NS, None, "received", range(0)),
        ("-1s", None, "received", range(199, 300)),
        ("2026-09-21T14:13:20.5Z", "2026-09-21T14:13:20.52Z", "received", range(50, 52)),
    ],
)
def test_ranges_are_half_open(store: Path, from_: Any, to: Any, by: By, expected: range) -> None:
    table = amberbox.open(store).query("odom", ["x"], from_, to, by)
    assert [int(x) for x in table.values("pose_x")] == list(expected)


def test_child_tables_are_items_of_their_own(store: Path) -> None:
    record = amberbox.open(store)
    table = record.query("odom__units")
    assert table.names == ["timestamp", "parent_seq", "index", "id"]
    expected = [(n * 10 + k, k) for n in range(300) for k in range(n % 3)]
    assert list(zip(table.values("id"), table.values("index"), strict=True)) == expected
    poses = record.query("odom", ["x", "seq"])
    seqs = dict(zip(poses.values("pose_x"), poses.values("seq"), strict=True))
    assert [seqs[n // 10] for n in table.values("id")] == table.values("parent_seq")


def test_elements_of_lists(store: Path) -> None:
    table = amberbox.open(store).query("odom", ["ranges[1]", "ranges"])
    assert table.names == ["timestamp", "ranges[1]", "ranges"]
    picked = [row["ranges[1]"] for row in table.rows()]
    assert picked == [1.0 if n % 4 > 1 else None for n in range(300)]
    assert [row["ranges"] for row in table.rows()][3] == [0.0, 1.0, 2.0]


def test_items_say_what_there_is(store: Path) -> None:
    found = {item.name: item for item in amberbox.open(store).items()}
    odom, battery = found["odom"], found["battery"]
    assert (odom.rows, odom.topic, odom.source, odom.type) == (300, "/odom", "test", "odom")
    assert (odom.first_ns, odom.last_ns) == (T0_NS, T0_NS + 2990 * MS)
    assert odom.rate_hz == pytest.approx(100.0)
    assert odom.stamp_offset_s == pytest.approx(0.003)
    assert odom.bytes == sum(len(json.dumps(pose(n), separators=(",", ":"))) for n in range(300))
    assert battery.stamp_offset_s is None
    assert found["odom__units"].rows == sum(n % 3 for n in range(300))
    assert odom.to_json()["first"] == "2026-09-21T14:13:20.000000000Z"


def test_variables_and_configured_selection(store: Path) -> None:
    record = amberbox.open(store)
    names = [column.name for column in record.variables("odom").columns]
    assert names == ["stamp", "pose_x", "pose_y", "ranges", "mode"]
    assert record.query("odom").names == ["timestamp", *names]
    assert record.query("battery").names == ["timestamp", "volts"]
    assert record.query("ODOM", ["x"]).item == "odom"


def test_thinning_keeps_extremes(store: Path) -> None:
    table = amberbox.open(store).query("odom", ["x", "y"], points=40)
    assert len(table) <= 40
    assert (max(table.values("pose_x")), min(table.values("pose_y"))) == (299.0, -74.75)


@pytest.mark.parametrize(
    ("item", "names", "what"),
    [
        ("odmo", None, "no data item 'odmo'"),
        ("odom", ["z"], "no variable 'z'"),
        ("odom__units", ["x"], "no variable 'x'"),
    ],
)
def test_unknown_names_are_wrong_usage(
    store: Path, item: str, names: list[str] | None, what: str
) -> None:
    with pytest.raises(UsageError, match=what) as caught:
        amberbox.open(store).query(item, names)
    assert caught.value.hint


def test_following_gives_the_same_rows(store: Path) -> None:
    record = amberbox.open(store)
    tables = follow_tables(record, "odom", ["x"], T0_NS + 2500 * MS, live=False)
    found = [int(x) for table in tables for x in table.values("pose_x")]
    assert found == list(range(250, 300))
    children = follow_tables(record, "odom__units", None, T0_NS + 2900 * MS, live=False)
    assert [i for t in children for i in t.values("id")] == [
        n * 10 + k for n in range(290, 300) for k in range(n % 3)
    ]


def test_conclusions_and_commands_are_followed_too(tmp_path: Path) -> None:
    FakeRun(tmp_path).write([(T0_NS, BATTERY, {"volts": 1.0})])
    for writer, topic in (("watch", "amberbox/status"), ("act", "amberbox/command")):
        run = FakeRun(tmp_path, writer=writer)
        for number in range(3):
            run.own(topic, T0_NS + number * NS, {"state": f"{writer} {number}"})
        run.close()
        tables = follow_tables(
            amberbox.open(tmp_path), topic.replace("/", "_"), ["state"], T0_NS + NS, live=False
        )
        found = [state for table in tables for state in table.values("state")]
        assert found == [f"{writer} 1", f"{writer} 2"]


def test_writers_and_runs_are_merged_by_receipt(tmp_path: Path) -> None:
    first = FakeRun(tmp_path)
    first.write([(T0_NS + n * 10, BATTERY, {"volts": float(n)}) for n in range(0, 40, 2)])
    ring = FakeRun(tmp_path, writer="ring")
    ring.write([(T0_NS + n * 10, BATTERY, {"volts": float(n)}) for n in range(1, 40, 2)])
    first.close()
    ring.close()
    table = amberbox.open(tmp_path).query("battery")
    assert table.values("volts") == [float(n) for n in range(40)]
    segments.build_segments(tmp_path, journals(tmp_path)[0])
    again = amberbox.open(tmp_path).query("battery")
    assert again.values("volts") == table.values("volts")


@pytest.mark.parametrize("with_segments", [False, True])
def test_receipt_is_corrected_by_the_clock_channel(tmp_path: Path, with_segments: bool) -> None:
    run = FakeRun(tmp_path)
    run.clock(T0_NS - 1, 0)
    run.write([(T0_NS + n * MS, BATTERY, {"volts": float(n)}) for n in range(10)])
    run.clock(T0_NS + 10 * MS, 300 * MS)
    run.write([(T0_NS + n * MS, BATTERY, {"volts": float(n)}) for n in range(10, 20)])
    run.close()
    if with_segments:
        build_segments_of(tmp_path)
        journals(tmp_path)[0].path.unlink()
    record = amberbox.open(tmp_path)
    table = record.query("battery", ["volts", "received"])
    expected = [T0_NS + n * MS + (300 * MS if n >= 10 else 0) for n in range(20)]
    assert table.values("received") == expected == table.values("timestamp")
    some = record.query("battery", ["volts"], T0_NS + 309 * MS, T0_NS + 312 * MS)
    assert some.values("volts") == [10.0, 11.0]
    assert record.last_ns() == T0_NS + 319 * MS


VALUES: list[dict[str, Any]] = [
    {"a": 2**53 + 1, "only_first": 0.5},
    {"a": 1.5, "b": "x"},
    {"a": "text", "b": None},
]
VERSIONS = [
    FakeItem("state", [VALUES[0]]),
    FakeItem("state", [VALUES[1]]),
    FakeItem("state", [{"a": "text", "b": "text"}]),
]


def write_versions(store: Path, count: int, *, rotate: bool) -> None:
    run = FakeRun(store)
    for number, (item, value) in enumerate(zip(VERSIONS[:count], VALUES, strict=False)):
        run.write([(T0_NS + number, item, value)])
        if rotate:
            run.rotate()
    run.close()


@pytest.mark.parametrize("rotate", [False, True])
@pytest.mark.parametrize("with_segments", [False, True])
def test_schema_versions_are_joined_with_nulls(
    tmp_path: Path, rotate: bool, with_segments: bool
) -> None:
    write_versions(tmp_path, 3, rotate=rotate)
    if with_segments:
        build_segments_of(tmp_path)
        files = sorted(path.name for path in (tmp_path / "segments/state").iterdir())
        assert len(files) == 3
    found = list(amberbox.open(tmp_path).query("state").rows())
    assert [row["a"] for row in found] == [str(2**53 + 1), "1.5", "text"]
    assert [row["b"] for row in found] == [None, "x", None]
    assert [row["only_first"] for row in found] == [0.5, None, None]


def test_whole_numbers_widen_to_floats(tmp_path: Path) -> None:
    write_versions(tmp_path, 2, rotate=False)
    record = amberbox.open(tmp_path)
    assert record.variables("state").columns[0].type == "float64"
    assert record.query("state", ["a"]).values("a") == [float(2**53), 1.5]


def test_importing_amberbox_alone_is_cheap() -> None:
    code = "import sys, amberbox; assert 'numpy' not in sys.modules; amberbox.open"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = amberbox.nothing
