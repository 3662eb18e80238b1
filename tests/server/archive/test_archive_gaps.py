"""Missing data have a reason: lost, deleted, to come, waiting."""

from __future__ import annotations

from pathlib import Path

from amberbox.core.clock import NS
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.journals import DELETED, LOST, MissingRows
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import T0_NS
from tests.server.archive.recordings import Robot


def _reasons(archive: FolderArchive) -> list[tuple[str, int | None, int | None]]:
    return [(gap.reason, gap.from_seq, gap.to_seq) for gap in archive.robot("r1").gaps()]


def test_ranges_that_never_came_have_their_reason(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=4)
    first, second, third, fourth = robot.files()
    for path in (first, fourth):
        robot.hand_in(archive, path)
    archive.commit()
    assert _reasons(archive) == [("not on the server yet", 81, 243)]
    span = (T0_NS + 4 * NS // 10, T0_NS + 8 * NS // 10)
    gone = MissingRows("main", 1, 81, 162, *span, DELETED, "for room")
    for _ in range(2):
        archive.note_missing("r1", robot.store_id, [gone])
    reason = "deleted on the robot before it was copied: for room"
    assert _reasons(archive) == [(reason, 81, 162), ("not on the server yet", 162, 243)]
    robot.hand_in(archive, third)
    waiting = "on the server, its columns are to come"
    assert _reasons(archive) == [(reason, 81, 162), (waiting, 162, 243)]
    clock.advance(61)
    archive.commit()
    assert _reasons(archive) == [(reason, 81, 162)]
    assert second.exists()


def test_what_a_power_cut_took_is_shown_and_never_merged(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=1)
    robot.hand_in_all(archive)
    lost = MissingRows("main", 1, 81, 90, T0_NS + NS, T0_NS + 2 * NS, LOST)
    archive.note_missing("r1", robot.store_id, [lost])
    archive.commit()
    (gap,) = archive.robot("r1").gaps()
    assert (gap.reason, gap.count) == ("lost at a power cut", 9)
    assert (gap.from_ns, gap.to_ns) == (T0_NS + NS, T0_NS + 2 * NS)
    assert archive.robot("r1").gaps(to=T0_NS + NS // 2) == []


def test_recorded_gaps_come_along(archive: FolderArchive, tmp_path: Path) -> None:
    robot = Robot("r1", tmp_path)
    run = robot.record(0, files=1)
    again = type(run)(robot.store, items=robot.items)
    gap = {"item": "odom", "peer": "", "from_ns": T0_NS, "to_ns": T0_NS + NS, "reason": "queue",
           "count": 7}  # fmt: skip
    again.own("amberbox/gap", T0_NS + NS, gap)
    again.close()
    robot.hand_in_all(archive)
    archive.commit()
    (found,) = archive.robot("r1").gaps("odom")
    assert (found.reason, found.count, found.run) == ("queue", 7, 2)
    assert archive.robot("r1").gaps("battery") == []
