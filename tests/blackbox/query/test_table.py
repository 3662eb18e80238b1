"""Tables: CSV, JSON, Arrow, pandas, polars, Parquet, and what one sees."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.query.record import LocalRecord
from amberbox.testing.records import T0_NS, fill_store

MS = 1_000_000


@pytest.fixture
def table(tmp_path: Path) -> Iterator[Any]:
    fill_store(tmp_path)
    with amberbox.open(tmp_path) as record:
        yield record.query("odom", ["x", "ranges[1]", "ranges", "mode"], to=T0_NS + 40 * MS)


def test_csv(table: Any) -> None:
    file = io.StringIO()
    table.to_csv(file)
    lines = file.getvalue().splitlines()
    assert lines[0] == "timestamp,pose_x,ranges[1],ranges,mode"
    assert lines[1] == "2026-09-21T14:13:19.997000000Z,0.0,,[],A"
    assert lines[4] == '2026-09-21T14:13:20.027000000Z,3.0,1.0,"[0.0,1.0,2.0]",B'


def test_json(table: Any) -> None:
    file, lines = io.StringIO(), io.StringIO()
    table.to_json(file)
    table.to_json(lines, lines=True)
    found = json.loads(file.getvalue())
    assert found == [json.loads(line) for line in lines.getvalue().splitlines()]
    assert found[3]["timestamp"] == "2026-09-21T14:13:20.027000000Z"
    assert found[0]["ranges[1]"] is None
    empty = io.StringIO()
    table.take(slice(0, 0)).to_json(empty)
    assert json.loads(empty.getvalue()) == []


def test_arrow_pandas_polars_parquet(table: Any, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    arrow = table.to_arrow()
    assert str(arrow.schema.field("timestamp").type) == "timestamp[ns, tz=UTC]"
    assert arrow["ranges"].to_pylist()[3] == [0.0, 1.0, 2.0]
    assert table.to_pandas()["pose_x"].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert table.to_polars()["mode"].to_list() == ["A", "B", "A", "B"]
    table.to_parquet(tmp_path / "t.parquet")
    assert pq.read_table(tmp_path / "t.parquet").equals(arrow)


def test_a_table_shows_itself(table: Any, tmp_path: Path) -> None:
    assert repr(table).splitlines()[0] == "odom: 4 rows"
    long = LocalRecord(tmp_path).query("odom", ["x"])
    assert len(repr(long).splitlines()) == 14
    assert "..." in repr(long)
