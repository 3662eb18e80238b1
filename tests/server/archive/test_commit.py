"""Journals become rows of tables: the same rows as on the robot, each exactly once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from amberbox.blackbox.query.record import LocalRecord, Record
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.server.archive.delta_files import segment_at
from amberbox.server.archive.folder import FolderArchive
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import BATTERY, POSE, T0_NS, FakeItem, FakeRun
from tests.server.archive.recordings import DAY_NS, Robot, positions


def same_answers(ours: Record, theirs: Record) -> None:
    """Compare items and rows of two records, one item after the other."""
    assert ours.items() == theirs.items()
    for info in theirs.items():
        mine, known = (record.query(info.name) for record in (ours, theirs))
        assert mine.fields == known.fields
        for name in known.names:
            assert mine.values(name) == known.values(name), (info.name, name)


def test_an_archive_answers_as_the_robot_does(archive: FolderArchive, tmp_path: Path) -> None:
    robot = Robot("ropod_001", tmp_path)
    robot.record(0)
    robot.record(500, files=1)
    robot.hand_in_all(archive)
    done = archive.commit()
    assert (done.journals, done.waiting) == (4, 0)
    same_answers(archive.robot("ropod_001"), LocalRecord(robot.store))
    window = {"from_": T0_NS + NS // 4, "to": T0_NS + NS}
    ours, theirs = (r.query("odom", **window) for r in (archive.robot(), LocalRecord(robot.store)))  # type: ignore[arg-type]  # both take ints
    assert len(ours) == len(theirs) == 75
    assert positions(archive.robot().query("odom", ["seq", "pose_x"])) == positions(
        LocalRecord(robot.store).query("odom", ["seq", "pose_x"])
    )


def test_a_journal_that_comes_again_changes_nothing(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0)
    robot.hand_in_all(archive)
    archive.commit()
    before = archive.robot().query("odom", ["seq", "pose_x"])
    assert [robot.hand_in(archive, path).is_new for path in robot.files()] == [False] * 3
    clock.advance(61)
    assert archive.commit().journals == 0
    after = archive.robot().query("odom", ["seq", "pose_x"])
    assert positions(before) == positions(after)


def test_another_content_under_a_known_name_is_refused(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=2)
    first, second = robot.files()
    robot.hand_in(archive, first)
    first.write_bytes(second.read_bytes())
    with pytest.raises(AmberboxError, match="with other content"):
        robot.hand_in(archive, first)


def test_a_table_gets_one_commit_a_minute(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=3)
    first, second, third = robot.files()
    robot.hand_in(archive, first)
    assert archive.commit().journals == 1
    robot.hand_in(archive, second)
    clock.advance(20)
    waits = archive.commit()
    assert (waits.journals, waits.waiting, round(waits.next_in_s)) == (0, 1, 40)
    robot.hand_in(archive, third)
    clock.advance(41)
    assert archive.commit().journals == 2
    versions = [s.version for s in map(archive.layout.snapshot, _tables(archive))]
    assert max(versions) == 2  # one to make the table, and two commits


def _tables(archive: FolderArchive) -> list[str]:
    tables = archive.layout.tables
    return [str(path.parent.relative_to(tables)) for path in tables.glob("*/*/_delta_log")]


def test_a_changed_schema_is_another_table_and_the_answer_their_union(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    older, newer = FakeItem("drive", [{"a": 1}]), FakeItem("drive", [{"a": 1.5, "b": "x"}])
    for number, (item, values) in enumerate(((older, {"a": 3}), (newer, {"a": 1.5, "b": "on"}))):
        run = FakeRun(robot.store, items=[item])
        run.write([(T0_NS + number * NS, item, values)])
        run.close()
    robot.hand_in_all(archive)
    archive.commit()
    table = archive.robot().query("drive", ["a", "b"])
    assert (table.values("a"), table.values("b")) == ([3.0, 1.5], [None, "on"])
    assert len([name for name in _tables(archive) if "." not in name]) == 2 + 0
    answer = archive.robot().sql("select a, b from drive order by received")
    assert (answer.values("a"), answer.values("b")) == ([3.0, 1.5], [None, "on"])


def test_two_robots_share_a_table_and_are_told_apart(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robots = [Robot(name, tmp_path) for name in ("r1", "r2")]
    for number, robot in enumerate(robots):
        robot.record(number * 1000, files=1, rows=3)
        robot.hand_in_all(archive)
    archive.commit()
    both = archive.robot().query("odom", ["pose_x"])
    told = sorted(zip(both.values("robot"), both.values("pose_x"), strict=True))
    assert told == [("r1", 0), ("r1", 1), ("r1", 2), ("r2", 1000), ("r2", 1001), ("r2", 1002)]
    alone = archive.robot("r2").query("odom", ["pose_x"])
    assert alone.names == ["timestamp", "pose_x"]
    assert alone.values("pose_x") == [1000, 1001, 1002]
    assert len([name for name in _tables(archive) if name.startswith("odom/")]) == 4
    counted = archive.robot().sql("select robot, count(*) n from odom group by 1 order by 1")
    assert counted.values("n") == [3, 3]


def test_ten_minutes_of_a_month_open_one_file(
    archive: FolderArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot("r1", tmp_path)
    for day in range(30):
        run = FakeRun(robot.store, items=[BATTERY])
        start_ns = T0_NS + day * DAY_NS
        run.write([(start_ns + n * NS, BATTERY, {"volts": day + n / 100}) for n in range(20)])
        run.close()
    robot.hand_in_all(archive)
    archive.commit()
    opened: list[str] = []

    def counting(tables: Path, path: str) -> object:
        opened.append(path)
        return segment_at(tables, path)

    monkeypatch.setattr("amberbox.server.archive.reader.segment_at", counting)
    start = T0_NS + 17 * DAY_NS
    table = archive.robot("r1").query("battery", ["volts"], start + NS, start + 600 * NS)
    assert table.values("volts") == [17 + n / 100 for n in range(1, 20)]
    assert len(opened) == 1
    assert "/robot=r1/day=2026-10-08/" in opened[0]


def test_other_readers_of_delta_tables_read_the_same_rows(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=2)
    robot.hand_in_all(archive)
    archive.commit()
    schema = next(s for s in archive.catalogue.schemas() if s.item == "odom")
    folder = archive.layout.tables / "odom" / schema.id
    script = (
        "import sys, json, os; from deltalake import DeltaTable; t = DeltaTable(sys.argv[1])\n"
        "rows = t.to_pyarrow_table().sort_by('seq').to_pylist()\n"
        "keys = ('robot', 'store_id', 'writer', 'run', 'seq', 'pose_x')\n"
        "print(json.dumps([str(rows[0]['day']), [[r[k] for k in keys] for r in rows]]),"
        "flush=True)\n"
        "os._exit(0)"
    )
    printed = subprocess.run(
        [sys.executable, "-c", script, str(folder)], check=True, capture_output=True, text=True
    ).stdout
    day, rows = json.loads(printed)
    known = positions(LocalRecord(robot.store).query("odom", ["seq", "pose_x"]))
    assert day == "2026-09-21"
    assert rows == [["r1", robot.store_id, "main", 1, seq, x] for seq, x in known]


def test_a_clock_that_was_put_right_moves_rows_as_on_the_robot(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot, hour_ns = Robot("r1", tmp_path), 3600 * NS
    run = FakeRun(robot.store, items=[BATTERY])
    for number, (offset_ns, right) in enumerate(((0, False), (hour_ns, True))):
        at_ns = T0_NS + number * 100 * NS
        reading = {"offset_ns": offset_ns, "synchronised": right, "boot_ns": at_ns - T0_NS + NS}
        run.own("amberbox/clock", at_ns, reading)
        run.write([(at_ns + n * NS, BATTERY, {"volts": float(n)}) for n in range(5)])
        run.rotate()
    run.close()
    first, second = robot.files()
    robot.hand_in(archive, first)
    archive.commit()
    assert archive.robot().query("battery").values("timestamp")[0] == T0_NS
    robot.hand_in(archive, second)
    clock.advance(61)
    archive.commit()
    ours, theirs = archive.robot().query("battery"), LocalRecord(robot.store).query("battery")
    assert ours.values("timestamp") == theirs.values("timestamp")
    assert ours.values("timestamp")[0] == T0_NS + hour_ns
    early = archive.robot().query("battery", None, T0_NS + hour_ns, T0_NS + hour_ns + 50 * NS)
    assert early.values("volts") == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert POSE.name not in {info.name for info in archive.robot().items()}
