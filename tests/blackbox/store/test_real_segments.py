"""Real recordings: segments give the same values as journals, column by column, and are smaller."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import amberbox
from amberbox.blackbox.columns.arrays import compact, null_mask
from amberbox.blackbox.query import record as query
from amberbox.blackbox.query.importing import import_recordings
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.table import Table
from amberbox.core.types import ColumnData, Ragged
from amberbox.testing.records import build_segments_of, fill_store

RECORDINGS = [
    "plotjuggler_tilt_laser.bag",
    "imu_ardrone.bag",
    "plotjuggler_fake_joint_state.bag",
    "plotjuggler_rosbag2_test",
    "rosbagjs_example.bag",
]


def bits(column: ColumnData) -> Any:
    if isinstance(column, Ragged):
        lists = compact(column)
        return lists.offsets.tolist(), bits(lists.values)
    if column.dtype == object:
        return column.tolist()
    mask = null_mask(column)
    values = np.where(mask, np.zeros(1, column.dtype), np.ma.getdata(column))
    return column.dtype.str, mask.tolist(), values.tobytes()


def tables(record: Record) -> Iterator[Table]:
    for item in record.items():
        names = [column.name for column in record.variables(item.name).columns]
        key = "parent_seq" if "__" in item.name else "seq"
        yield record.query(item.name, [*names, "received", key])


def check(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build_segments_of(store)
    record = amberbox.open(store)
    from_segments = list(tables(record))
    items = record.items()
    monkeypatch.setattr(query, "can_build", lambda: False)
    from_journals = list(tables(record))
    assert record.items() == items
    for one, other in zip(from_segments, from_journals, strict=True):
        assert one.fields == other.fields
        assert len(one) == len(other) > 0
        for name in one.names:
            assert bits(one[name]) == bits(other[name]), f"{one.item}.{name}"


@pytest.mark.needs_data
@pytest.mark.parametrize("name", RECORDINGS)
def test_real_segments_say_what_journals_say(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    store = tmp_path / "store"
    import_recordings([shared_data / "recordings" / name], store)
    check(store, monkeypatch)


def test_generated_segments_say_what_journals_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_store(tmp_path)
    check(tmp_path, monkeypatch)


@pytest.mark.needs_data
def test_real_segments_are_smaller_than_plain_parquet(shared_data: Path, tmp_path: Path) -> None:
    store = tmp_path / "store"
    import_recordings([shared_data / "recordings" / "imu_ardrone.bag"], store)
    build_segments_of(store)
    (path,) = (store / "segments/ros_ardrone_imu").iterdir()
    pq.write_table(pq.read_table(path), tmp_path / "plain.parquet", compression="zstd")
    assert path.stat().st_size <= 0.85 * (tmp_path / "plain.parquet").stat().st_size


@pytest.mark.needs_data
def test_a_recording_file_can_be_asked_directly(shared_data: Path) -> None:
    with amberbox.open(shared_data / "recordings" / "rosbagjs_example.bag") as record:
        place = record.path
        assert {item.name for item in record.items()} >= {"ros_turtle1_pose"}
        assert len(record.query("ros_turtle1_pose", ["x"], points=10)) <= 10
    assert not place.exists()
