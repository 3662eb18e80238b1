"""The manifest: appended lines are read back, whatever happens to the file's end or middle."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import manifest_entries as entries
from amberbox.blackbox.store.clocks import ClockPoints, ClockTable
from amberbox.core.types import Column, Gap

SCHEMA = TableSchema(
    "odom",
    "nav_msgs/Odometry",
    (Column("x", "pose/x", "float64", "m"), Column("mode", "mode", "uint8", "", {0: "OFF"})),
    stamp="header/stamp",
)


def segment(
    number: int, journals: tuple[str, ...] = (), item: str = "odom", files: int = 1
) -> entries.Segment:
    names = journals or (f"journal/{number}.mcap",)
    parts = tuple(
        entries.SegmentPart(name, "head", "main", 1, 10 * n, 10 * n + 9, 10, 100 * n, 100 * n + 90,
                100 * n, 100 * n + 90, files, 1000, 5, ((100 * n, 0),))
        for n, name in enumerate(names, number)
    )  # fmt: skip
    path = f"segments/{item}/{number}{'+' * (len(names) > 1)}.parquet"
    return entries.Segment(path, item, SCHEMA.id, 10 * len(parts), 999, "ab" * 32, parts)


def journal(name: str) -> mf.ManifestJournal:
    gap = Gap("main", 1, 5, 6, "undecodable", "odom", 1, 3, 4)
    return mf.ManifestJournal(name, "head", "main", 1, 0, 10, 100, 190, (gap,), {"odom": ["x"]})


def test_what_is_appended_is_read(tmp_path: Path) -> None:
    assert mf.read_lines(tmp_path) == mf.Manifest()
    done = journal("journal/0.mcap")
    mf.append(tmp_path, [mf.schema_record(SCHEMA), mf.segment_record(segment(0))])
    mf.append(tmp_path, [mf.journal_record(done)])
    known = mf.read_lines(tmp_path)
    assert known.schemas == {SCHEMA.id: SCHEMA}
    assert known.segments == {"odom": (segment(0),)}
    assert known.journals == {"journal/0.mcap": done}
    assert known.complete("odom") == {"journal/0.mcap"}
    assert not known.damage


def test_each_line_is_json_chained_to_the_one_before(tmp_path: Path) -> None:
    mf.append(tmp_path, [mf.segment_record(segment(n)) for n in range(3)])
    lines = [json.loads(line) for line in (tmp_path / mf.NAME).read_text().splitlines()]
    assert [line["prev"] for line in lines] == ["0" * 64, lines[0]["hash"], lines[1]["hash"]]


def test_a_segment_takes_the_place_of_those_it_replaces(tmp_path: Path) -> None:
    small = [segment(n) for n in range(3)]
    mf.append(tmp_path, [mf.segment_record(s) for s in small])
    merged = segment(0, tuple(s.parts[0].journal for s in small))
    mf.append(tmp_path, [mf.segment_record(merged, [s.path for s in small])])
    known = mf.read_lines(tmp_path)
    assert known.segments == {"odom": (merged,)}
    assert known.complete("odom") == {f"journal/{n}.mcap" for n in range(3)}


def test_a_journal_counts_when_all_files_of_its_schema_versions_are_there(tmp_path: Path) -> None:
    mf.append(tmp_path, [mf.segment_record(segment(0, files=2))])
    known = mf.read_lines(tmp_path)
    assert known.complete("odom") == frozenset()
    assert known.complete("odom", existing=()) == {"journal/0.mcap"}
    assert known.complete("odom", existing={"journal/0.mcap"}) == frozenset()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_torn_end_costs_the_last_record_only(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / mf.NAME
    path.unlink(missing_ok=True)
    mf.append(tmp_path, [mf.segment_record(segment(n)) for n in range(3)])
    content = path.read_bytes()
    last = content.rstrip(b"\n").rfind(b"\n") + 1
    cut = data.draw(st.integers(last, len(content) - 1))
    path.write_bytes(content[:cut])
    torn = mf.read_lines(tmp_path)
    whole = cut == len(content) - 1  # only the newline is missing
    assert len(torn.segments["odom"]) == (3 if whole else 2)
    assert bool(torn.damage) == (last < cut < len(content) - 1)
    mf.append(tmp_path, [mf.segment_record(segment(7))])
    again = mf.read_lines(tmp_path)
    assert [s.path for s in again.segments["odom"]][-1] == segment(7).path
    assert len(again.segments["odom"]) == (4 if whole else 3)


def test_a_changed_line_is_left_out_and_named(tmp_path: Path) -> None:
    mf.append(tmp_path, [mf.segment_record(segment(n)) for n in range(3)])
    path = tmp_path / mf.NAME
    content = path.read_bytes()
    at = content.index(b"1.parquet")
    path.write_bytes(content[:at] + b"6" + content[at + 1 :])
    known = mf.read_lines(tmp_path)
    assert [s.path for s in known.segments["odom"]] == [segment(0).path, segment(2).path]
    assert known.damage == ("line 2: damaged", "line 3: does not follow the line before")


def test_unknown_kinds_of_records_are_chained_and_passed_over(tmp_path: Path) -> None:
    mf.append(tmp_path, [{"kind": "signature", "by": "key"}, mf.segment_record(segment(0))])
    known = mf.read_lines(tmp_path)
    assert not known.damage
    assert known.segments == {"odom": (segment(0),)}


@pytest.mark.parametrize("points", [(), ((-50, 7),), ((-50, 7), (20, -3), (95, 4), (200, 9))])
def test_a_part_s_clock_says_the_same_as_the_journal_s(points: ClockPoints) -> None:
    times = np.arange(0, 91)
    part = entries.SegmentPart("j", "", "main", 1, 0, 9, 10, 0, 90, 0, 90, clock=points)
    assert (
        ClockTable(entries.part_clock(part)).received(times) == ClockTable(points).received(times)
    ).all()
    one = entries.Segment("p", "odom", "s", 10, 1, "", (part,))
    received = ClockTable(points).received(times)
    low, high = one.received_range_ns
    assert low <= received.min() <= received.max() <= high
