"""A snapshot of a record: each row once, also during a commit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import delete, insert

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.table_reader import RowRequest
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.types import Schema, Topic
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.reader import ArchiveReader
from amberbox.server.data import query as reading
from amberbox.server.data import snapshot as looking
from amberbox.server.data.query import RowQuery, rows
from amberbox.server.data.snapshot import RecordSnapshot, SnapshotRecord, with_snapshot
from amberbox.server.data.worker import described_json, item_json, items_json
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.schema import STATUS
from amberbox.server.workers.protocol import LimitError
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import POSE, T0_NS, FakeItem, FakeRun, pose
from tests.server.archive.recordings import Robot

_MS = 1_000_000
LATE = (
    "complete until 2026-09-21T14:13:21Z; the robot has data until 2026-09-21T14:14:21Z: "
    "amberbox fetch URL odom 2026-09-21T14:13:21Z 2026-09-21T14:14:21Z --wait"
)


@pytest.fixture
def archive(tmp_path: Path) -> FolderArchive:
    found = FolderArchive(tmp_path / "server", clock=ManualClock())
    robot = Robot("r1", tmp_path)
    robot.record(0)
    robot.hand_in_all(found)
    return found


def xs(seen: RecordSnapshot) -> list[float]:
    found = rows(seen, RowQuery("r1", "odom", ["pose_x"]))
    return [float(value) for value in found.table.values("pose_x")]


def test_rows_that_wait_are_there(archive: FolderArchive) -> None:
    folder = archive.layout.folder
    assert with_snapshot(folder, "r1", xs) == list(range(120))
    archive.commit(0)
    assert with_snapshot(folder, "r1", xs) == list(range(120))


def test_a_journal_that_is_committed_during_the_look_counts_once(archive: FolderArchive) -> None:
    catalogue, layout = archive.catalogue, ArchiveLayout(archive.layout.folder)
    waiting = looking._waiting(catalogue, layout, "r1")
    archive.commit(0)
    reader = ArchiveReader(layout, catalogue, catalogue.sources(["r1"]))
    assert xs(RecordSnapshot(reader, catalogue, waiting)) == list(range(120))


def test_a_record_says_the_same_before_and_after_its_commit(tmp_path: Path) -> None:
    """A run is judged by its journals as soon as they have come, by the archive later."""
    archive = FolderArchive(tmp_path / "server", clock=ManualClock())
    robot = Robot("r1", tmp_path)
    run = FakeRun(robot.store, items=robot.items)
    run.start(T0_NS - 1)
    run.write([(T0_NS + n * 10 * _MS, POSE, pose(n)) for n in range(50)])
    dropped = {"item": "odom", "peer": "", "from_ns": T0_NS + 20 * _MS, "to_ns": T0_NS + 40 * _MS,
               "reason": "dropped: the queue is full", "count": 2}  # fmt: skip
    run.own(channels.GAP, T0_NS + 500 * _MS, dropped)
    run.close()
    robot.hand_in_all(archive)
    span = T0_NS, T0_NS + NS
    record = SnapshotRecord(archive.layout.folder, archive.catalogue, ("r1",), span=span)

    def answers() -> list[object]:
        whole, after = record.gaps("odom", *span), record.gaps("odom", T0_NS + 50 * _MS, span[1])
        values = record.query("odom", ["pose_x"], *span).values("pose_x")
        names = [info.name for info in record.items()]
        return [values, [(g.from_ns, g.to_ns, g.reason) for g in whole], after, record.last_ns(),
                names, record.has_item("odom"), record.variables("odom")]  # fmt: skip

    before = answers()
    assert before[:3] == [
        list(range(50)),
        [(T0_NS + 20 * _MS, T0_NS + 40 * _MS, "dropped: the queue is full")],
        [],
    ]
    archive.commit(0)
    assert answers() == before


def test_what_is_still_on_the_robot_is_said_and_how_to_get_it(archive: FolderArchive) -> None:
    """The newest status arrived over the link a minute after the end of the copied data."""
    folder = archive.layout.folder
    end_ns = T0_NS + 1_190 * _MS
    status = {"robot": "r1", "component": "c", "mode": "", "level": "ok", "store_id": "s",
              "run": 1, "seq": 1, "received_ns": 1, "data": b""}  # fmt: skip

    def notes(to_ns: int | None = None) -> list[str]:
        asked = RowQuery("r1", "odom", ["pose_x"], to_ns=to_ns)
        return with_snapshot(folder, "r1", lambda seen: rows(seen, asked).about.notes)

    database = ServerDatabase(folder / FILE)
    assert notes() == []
    for late_ns, said in ((NS, []), (60 * NS, [LATE])):
        with database.begin() as connection:
            connection.execute(delete(STATUS))
            connection.execute(insert(STATUS), [{**status, "log_ns": end_ns + late_ns}])
        assert notes() == said
        assert notes(end_ns - NS) == [], "a range that was copied lacks nothing"
    database.close()


def test_what_is_too_much_to_read_is_said(
    archive: FolderArchive, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = min(row.bytes for row in archive.catalogue.journals())
    monkeypatch.setattr(looking, "READ_BYTES", 2.5 * size)

    def incomplete(seen: RecordSnapshot) -> tuple[list[float], int | None]:
        answer = rows(seen, RowQuery("r1", "odom", ["pose_x"]))
        return answer.table.values("pose_x"), answer.about.complete_ns

    found, complete_ns = with_snapshot(archive.layout.folder, "r1", incomplete)
    assert found == list(range(40, 120))
    assert complete_ns is not None
    assert complete_ns <= T0_NS


def test_long_ranges_are_summed_up(archive: FolderArchive, monkeypatch: pytest.MonkeyPatch) -> None:
    archive.commit(0)
    monkeypatch.setattr(reading, "THINNED_ROWS", 50)
    asked = RowQuery("r1", "odom", ["pose_x", "mode"], points=4)
    answer = with_snapshot(archive.layout.folder, "r1", lambda seen: rows(seen, asked))
    assert answer.about.kind == "envelope"
    assert "mode" in answer.about.notes[-1]
    low, high = (answer.table.values(f"pose_x:{end}") for end in ("min", "max"))
    assert (min(low), max(high)) == (0.0, 119.0)
    with pytest.raises(LimitError, match="only numbers"):
        only = RowQuery("r1", "odom", ["mode"], points=4)
        with_snapshot(archive.layout.folder, "r1", lambda seen: rows(seen, only))


def test_rows_of_one_instant_are_not_torn_apart() -> None:
    times = np.array([1, 2, 2, 2, 3])
    assert reading._cut(times, 2) == (1, 2)
    assert reading._cut(times[1:], 2) == (3, 3)
    assert reading._cut(times[1:4], 2) == (3, None)
    assert reading._cut(times, 5) == (5, None)


def test_only_files_of_the_range_are_read(archive: FolderArchive) -> None:
    archive.commit(0)
    span = T0_NS + 200 * _MS, T0_NS + 300 * _MS
    request = RowRequest("odom", ("pose_x",), span)
    late = RowRequest("odom", ("pose_x",), (span[1] + 10**12, None))

    def count(seen: RecordSnapshot) -> tuple[int, int]:
        seen.rows(request)
        first = seen.reader.files_read
        seen.rows(late)
        return first, seen.reader.files_read - first

    assert with_snapshot(archive.layout.folder, "r1", count) == (1, 0)


def test_a_robot_without_data_has_no_items(archive: FolderArchive) -> None:
    with pytest.raises(UsageError, match="no data item"):
        with_snapshot(archive.layout.folder, "r9", lambda seen: seen.schema("odom"))


@dataclass(frozen=True)
class Blob(FakeItem):
    """Messages whose definition cannot be read, or that do not fit it."""

    definition: bytes = b""

    def mcap_topic(self) -> Topic:
        return Topic(f"/{self.name}", "ros1", Schema("a/B", "ros1msg", self.definition))


def test_items_without_columns_are_listed_with_the_reason(tmp_path: Path) -> None:
    """While their journal waits, when it is in columns, and when there are others besides."""
    archive = FolderArchive(tmp_path / "server", clock=ManualClock())
    blob = Blob("ros_blob", [{"x": 1}], source="ros", definition=b"nothing/Known x\n")
    unfit = Blob("ros_misfit", [{"x": 1}], source="ros", definition=b"float64 x\n")
    robot = Robot("r1", tmp_path, items=[POSE, blob, unfit])
    run = FakeRun(robot.store, items=robot.items)
    run.write([(T0_NS + n, item, pose(n)) for n in range(3) for item in robot.items])
    run.close()
    robot.hand_in_all(archive)
    for committed in (False, True):
        if committed:
            archive.commit(0)
        found = {one["name"]: one for one in with_snapshot(archive.layout.folder, "r1", items_json)}
        raw = found["ros_blob"]
        assert raw["rows"] == 3 and raw["source"] == "ros", committed
        assert "nothing/msg/Known is missing" in raw["no_columns"]
        assert found["odom"]["no_columns"] == ""
        misfit = found["ros_misfit"]
        assert misfit["rows"] == 3
        assert ("do not fit" in misfit["no_columns"]) is committed, "known when it is read"
        detail = with_snapshot(
            archive.layout.folder, "r1", lambda seen: item_json(seen, "ros_blob")
        )
        assert detail is not None and detail["columns"] == [], committed
        assert (
            with_snapshot(archive.layout.folder, "r1", lambda seen: item_json(seen, "other"))
            is None
        )
        described = with_snapshot(archive.layout.folder, "r1", described_json)
        assert "ros_blob" not in {one["name"] for one in described}
