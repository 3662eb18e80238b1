"""CSV and Parquet contain the rows of a query, for any range, from journals and segments."""

from __future__ import annotations

import csv
import io
import json
import tracemalloc
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import amberbox
from amberbox.blackbox.query import export_job
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportOptions, ExportReport, View, ordered_windows
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import segment_builder as segments
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.manifest_entries import Tombstone, to_record
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.testing.records import (
    BATTERY,
    POSE,
    T0_NS,
    FakeItem,
    FakeRun,
    build_segments_of,
    fill_store,
    pose_rows,
)
from tests.blackbox.query.conftest import STORES, filled_as

MS = 1_000_000


@pytest.fixture(params=STORES)
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(export_job, "SLICE_ROWS", 40)
    return filled_as(request.param, tmp_path / "store", monkeypatch, export_job)


@pytest.fixture
def filled(tmp_path: Path) -> Path:
    fill_store(tmp_path / "store")
    return tmp_path / "store"


def run(store: Path, target: Path, form: str, **view: Any) -> ExportReport:
    return export(amberbox.open(store), View(**view), target, form)


def as_csv(store: Path, item: str, *args: Any, **kwargs: Any) -> str:
    file = io.StringIO()
    amberbox.open(store).query(item, *args, **kwargs).to_csv(file)
    return file.getvalue()


def test_csv_has_the_rows_of_a_query(store: Path, tmp_path: Path) -> None:
    report = run(store, tmp_path / "out", "csv")
    assert not report.missing
    assert report.counts == {"battery": 30, "odom": 300, "odom__units": 300}
    for item in report.counts:
        assert (tmp_path / "out" / f"{item}.csv").read_text() == as_csv(store, item)
    assert report.bytes == sum(file.stat().st_size for file in (tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("from_ns", "to_ns", "by"),
    [
        (T0_NS + 500 * MS, T0_NS + 1205 * MS, "received"),
        (T0_NS + 497 * MS, T0_NS + 1197 * MS, "timestamp"),
        (None, T0_NS + 5 * MS, "received"),
        (T0_NS + 10_000 * NS, None, "received"),
    ],
)
def test_a_window_is_that_of_a_query(
    store: Path, tmp_path: Path, from_ns: int | None, to_ns: int | None, by: Any
) -> None:
    names = ["x", "ranges", "received"]
    chosen = {"variables": {"odom": names}, "windows": [(from_ns, to_ns)], "by": by}
    run(store, tmp_path / "out.csv", "csv", **chosen)
    assert (tmp_path / "out.csv").read_text() == as_csv(store, "odom", names, from_ns, to_ns, by)


def test_parquet_has_the_types_of_a_query_and_says_what_it_is(store: Path, tmp_path: Path) -> None:
    run(store, tmp_path / "out", "parquet")
    for item in ("odom", "odom__units", "battery"):
        table = pq.read_table(tmp_path / "out" / f"{item}.parquet")
        assert table.equals(amberbox.open(store).query(item).to_arrow())
    field = pq.read_schema(tmp_path / "out" / "odom.parquet").field("pose_x")
    assert field.metadata[b"path"] == b"pose/x"
    table = pq.read_metadata(tmp_path / "out" / "odom.parquet").metadata[b"amberbox.table"]
    assert json.loads(table)["topic"] == "/odom"


def test_several_windows_follow_each_other(filled: Path, tmp_path: Path) -> None:
    windows = [(T0_NS + 2 * NS, T0_NS + 2 * NS + 20 * MS), (T0_NS, T0_NS + 15 * MS)]
    run(filled, tmp_path / "out.csv", "csv", variables={"odom": ["x"]}, windows=windows)
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    assert [float(row["pose_x"]) for row in rows] == [0, 1, 200, 201]


def test_windows_that_meet_are_one() -> None:
    assert ordered_windows([(5, 9), (1, 3), (3, 4), (8, None), (20, 30)]) == [(1, 4), (5, None)]
    assert ordered_windows([(None, 2), (7, 8), (2, 3)]) == [(None, 3), (7, 8)]
    with pytest.raises(UsageError, match="ends before it begins"):
        ordered_windows([(5, 5)])


def test_columns_that_were_not_configured_come_when_asked(tmp_path: Path) -> None:
    chosen = FakeItem("odom", POSE.examples, stamp="stamp", variables=["pose/x"])
    record = FakeRun(tmp_path / "store", items=[chosen])
    record.start(T0_NS - 1)
    record.write([(at, chosen, v) for at, item, v in pose_rows(0, 5) if item is POSE])
    record.close()
    run(tmp_path / "store", tmp_path / "few.csv", "csv", items=["odom"])
    assert (tmp_path / "few.csv").read_text().splitlines()[0] == "timestamp,pose_x"
    everything = {"all_variables": True, "received": True}
    run(tmp_path / "store", tmp_path / "all", "csv", **everything)
    header = (tmp_path / "all" / "odom.csv").read_text().splitlines()[0]
    assert header == "timestamp,stamp,pose_x,pose_y,ranges,mode,received,seq"
    header = (tmp_path / "all" / "odom__units.csv").read_text().splitlines()[0]
    assert header == "timestamp,parent_seq,index,id,received"


def test_the_box_itself_only_when_asked(filled: Path, tmp_path: Path) -> None:
    assert "amberbox_run" in run(filled, tmp_path / "with", "csv", with_box=True).counts
    report = run(filled, tmp_path / "one", "csv", items=["battery"], with_box=True)
    assert sorted(report.counts) == ["amberbox_run", "battery"]
    assert run(filled, tmp_path / "run.csv", "csv", items=["amberbox_run"]).total == 1


SAYINGS = ["=1+1", "+1", "-1", "@sum", "\tx", "\rx", "|x", " =1", "fine", "", "a=b", "'=1"]


def test_text_that_is_a_formula_does_nothing(tmp_path: Path) -> None:
    item = FakeItem("said", [{"text": "a", "number": -1.5, "data": ["=1"]}])
    record = FakeRun(tmp_path / "store")
    record.write([
        (T0_NS + n, item, {"text": text, "number": -1.5, "data": ["=1"]})
        for n, text in enumerate(SAYINGS)
    ])  # fmt: skip
    record.close()
    view = View(items=["said"])
    with amberbox.open(tmp_path / "store") as opened:
        export(opened, view, tmp_path / "out.csv", "csv")
        export(opened, view, tmp_path / "raw.csv", "csv", options=ExportOptions(raw_text=True))
    rows = list(csv.DictReader((tmp_path / "out.csv").open(newline="")))
    assert [row["text"] for row in rows] == [f"'{t}" for t in SAYINGS[:8]] + SAYINGS[8:]
    assert {(row["number"], row["data"]) for row in rows} == {("-1.5", '["=1"]')}
    rows = list(csv.DictReader((tmp_path / "raw.csv").open(newline="")))
    assert [row["text"] for row in rows] == SAYINGS
    shown = list(csv.DictReader(io.StringIO(as_csv(tmp_path / "store", "said"), newline="")))
    assert [row["text"] for row in shown][:8] == [f"'{text}" for text in SAYINGS[:8]]


def test_a_segment_joined_meanwhile_costs_no_row(
    filled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first rows all journals become segments, which are joined: files go."""
    build_segments_of(filled, 1)
    monkeypatch.setattr(segments, "MERGE_COUNT", 2)
    monkeypatch.setattr(export_job, "SLICE_ROWS", 40)
    done: list[float] = []

    def go_on(fraction: float) -> None:
        if not done:
            build_segments_of(filled)
            assert segments.merge_small(filled)
            for journal in [journal for journal in journals(filled) if journal.finished]:
                journal.path.unlink()
        done.append(fraction)

    before = as_csv(filled, "odom")
    report = export(amberbox.open(filled), View(items=["odom"]), tmp_path / "out.csv", "csv", go_on)
    assert (tmp_path / "out.csv").read_text() == before
    assert len(done) > 2 and done == sorted(done)
    assert not report.missing


def test_a_damaged_segment_is_replaced_by_its_journal(filled: Path, tmp_path: Path) -> None:
    build_segments_of(filled)
    before = as_csv(filled, "odom")
    damaged = sorted((filled / "segments" / "odom").glob("*.parquet"))[1]
    content = bytearray(damaged.read_bytes())
    content[50:900] = bytes(850)
    damaged.write_bytes(content)
    report = run(filled, tmp_path / "out.csv", "csv", items=["odom"])
    assert (tmp_path / "out.csv").read_text() == before
    assert any(f"{damaged.name} is damaged, its journal was read" in n for n in report.notes)
    for journal in [journal for journal in journals(filled) if journal.finished]:
        journal.path.unlink()
    report = run(filled, tmp_path / "out.csv", "csv", items=["odom"])
    assert (tmp_path / "out.csv").read_text().count("\n") == 1 + 200
    assert any("100 rows are lost" in text for text in report.missing)


def test_a_journal_deleted_meanwhile_is_named(
    filled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export_job, "SLICE_ROWS", 40)
    last = journals(filled)[-1]

    def delete(fraction: float) -> None:
        last.path.unlink(missing_ok=True)

    report = export(
        amberbox.open(filled), View(items=["odom"]), tmp_path / "out.csv", "csv", delete
    )
    assert report.counts == {"odom": 200}
    assert report.missing == [f"{last.name} was deleted while it was being exported"]


def test_columns_deleted_meanwhile_are_named(
    filled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build_segments_of(filled)
    monkeypatch.setattr(export_job, "SLICE_ROWS", 40)
    known, held = mf.read(filled), journals(filled)
    last = max(known.journals.values(), key=lambda journal: journal.first_seq)
    for journal in held:
        if journal.name in known.journals:
            journal.path.unlink()
    stone = Tombstone(
        (last.name,), "columns", last.writer, last.run, last.first_seq, last.end_seq,
        last.start_ns, last.end_ns, last.head, "for room", False, 0,
    )  # fmt: skip

    def delete(fraction: float) -> None:
        if last.name in mf.read(filled).journals:
            mf.append(filled, [to_record(stone)])
            for path in mf.read(filled).gone_segments:
                (filled / path).unlink()

    report = export(
        amberbox.open(filled), View(items=["odom"]), tmp_path / "out.csv", "csv", delete
    )
    assert f"{last.name} was deleted while it was being exported" in report.missing


def test_of_a_store_whose_files_vanish_the_rest_is_exported(filled: Path, tmp_path: Path) -> None:
    build_segments_of(filled)
    for path in (filled / "segments" / "odom").glob("*"):
        path.unlink()
    for journal in [journal for journal in journals(filled) if journal.finished]:
        journal.path.unlink()
    report = run(filled, tmp_path / "out.csv", "csv", items=["odom"])
    assert report.counts == {"odom": 100}
    assert ["it is gone" in missing for missing in report.missing] == [True, True]


@pytest.mark.parametrize("form", ["csv", "parquet", "mcap", "mcap-json"])
def test_an_interrupted_export_leaves_nothing(filled: Path, tmp_path: Path, form: str) -> None:
    def interrupt(fraction: float) -> None:
        raise KeyboardInterrupt

    target = tmp_path / "out" / ("x" if form in ("csv", "parquet") else "x.mcap")
    target.parent.mkdir()
    with pytest.raises(KeyboardInterrupt):
        export(amberbox.open(filled), View(), target, form, interrupt)
    assert list(target.parent.iterdir()) == []


def test_targets_that_cannot_be(filled: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="one file cannot hold 2 tables: battery, odom"):
        run(filled, tmp_path / "out.csv", "csv")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("keep")
    with pytest.raises(UsageError, match="is there already"):
        run(filled, tmp_path / "full", "csv")
    with pytest.raises(UsageError, match="no format 'xlsx'"):
        run(filled, tmp_path / "out", "xlsx")
    with pytest.raises(UsageError, match="no data item 'odon'"):
        run(filled, tmp_path / "out", "csv", items=["odon"])
    (tmp_path / "empty").mkdir()
    assert run(filled, tmp_path / "empty", "csv", items=["battery"]).total == 30


def test_what_lies_beside_the_target_stays(filled: Path, tmp_path: Path) -> None:
    (tmp_path / "out.part").mkdir()
    (tmp_path / "out.part" / "mine.txt").write_text("mine")
    (tmp_path / "one.csv.part").write_text("mine")
    run(filled, tmp_path / "out", "csv")
    run(filled, tmp_path / "one.csv", "csv", items=["battery"])
    assert (tmp_path / "out.part" / "mine.txt").read_text() == "mine"
    assert (tmp_path / "one.csv.part").read_text() == "mine"
    assert len(list(tmp_path.glob("*.part"))) == 2


@pytest.mark.parametrize("built", [True, False])
def test_memory_does_not_grow_with_the_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: bool
) -> None:
    monkeypatch.setattr(export_job, "SLICE_ROWS", 100)
    monkeypatch.setattr(segments, "GROUP_ROWS", 100)
    peaks = []
    for files in (2, 6):
        store = tmp_path / f"store{files}"
        item = FakeItem("data", [{"values": [1.0] * 100}])
        record = FakeRun(store)
        for part in range(files):
            rows = range(part * 200, (part + 1) * 200)
            record.write([(T0_NS + n * NS, item, {"values": [float(n)] * 100}) for n in rows])
            record.rotate()
        record.close()
        if built:
            build_segments_of(store)
        run(store, tmp_path / "warm.csv", "csv", items=["data"])
        tracemalloc.start()
        run(store, tmp_path / f"{files}.csv", "csv", items=["data"])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_an_item_of_main_and_ring_comes_in_order(tmp_path: Path) -> None:
    for writer, start in (("main", 0), ("ring", 5)):
        record = FakeRun(tmp_path / "store", writer)
        record.write([(T0_NS + (2 * n + start) * MS, BATTERY, {"volts": 24.0}) for n in range(9)])
        record.close()
    run(tmp_path / "store", tmp_path / "out.csv", "csv", items=["battery"])
    assert (tmp_path / "out.csv").read_text() == as_csv(tmp_path / "store", "battery")
    times = [row["timestamp"] for row in csv.DictReader((tmp_path / "out.csv").open())]
    assert len(times) == 18 and times == sorted(times)
