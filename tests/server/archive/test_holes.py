"""The gap of a refused file is reported, whether its rows are known or only its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Gap
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.gaps import TO_COME, RefusedFile, gaps_of
from amberbox.server.archive.reader import ArchiveReader
from amberbox.testing.records import T0_NS
from tests.server.archive.recordings import Robot

ROWS = 81
"""Rows of the files of a run but the last one, which is shorter."""
CAME_NS = T0_NS + 3600 * NS


def recorded(archive: FolderArchive, tmp_path: Path, *held: int, files: int = 5) -> Robot:
    """Record five files and hand some of them in."""
    robot = Robot("r1", tmp_path)
    robot.record(0, files=files)
    for number in held:
        robot.hand_in(archive, robot.files()[number])
    archive.commit()
    return robot


def refused(robot: Robot, number: int, **known: int) -> RefusedFile:
    file = f"journal/{robot.files()[number].name}"
    return RefusedFile("main", 1, number, file, "altered", CAME_NS, **known)


def gaps(archive: FolderArchive, robot: Robot, *files: RefusedFile) -> list[Gap]:
    source = RobotStore("r1", robot.store_id)
    reader = ArchiveReader(archive.layout, archive.catalogue, [source])
    return gaps_of(reader, archive.catalogue, None, (None, None), {source: files})


def said(found: list[Gap]) -> list[tuple[str, int | None]]:
    return [(gap.reason.partition(":")[0], gap.count) for gap in found]


def test_a_hole_whose_files_are_all_refused(archive: FolderArchive, tmp_path: Path) -> None:
    robot = recorded(archive, tmp_path, 0, 3, 4)
    assert said(gaps(archive, robot)) == [(TO_COME, 2 * ROWS)]
    files = [refused(robot, number) for number in (1, 2)]
    (found,) = gaps(archive, robot, *files)
    assert found.reason == f"refused: {files[0].file}: altered, and 1 more"
    assert (found.count, found.from_seq, found.to_seq) == (2 * ROWS, ROWS, 3 * ROWS)


def test_a_hole_in_which_something_else_is_to_come(archive: FolderArchive, tmp_path: Path) -> None:
    robot = recorded(archive, tmp_path, 0, 3, 4)
    found = gaps(archive, robot, refused(robot, 2))
    assert sorted(said(found), key=str) == [(TO_COME, None), ("refused", None)]
    assert len({(gap.from_ns, gap.to_ns) for gap in found}) == 1


def test_a_file_elsewhere_explains_no_hole(archive: FolderArchive, tmp_path: Path) -> None:
    robot = recorded(archive, tmp_path, 0, 2, 4)
    assert said(gaps(archive, robot, refused(robot, 3))) == [(TO_COME, ROWS), ("refused", ROWS)]


def test_a_file_whose_seal_tells_its_rows(archive: FolderArchive, tmp_path: Path) -> None:
    robot = recorded(archive, tmp_path, 0, 3, 4)
    at_ns = T0_NS + 400 * 10**6
    file = refused(robot, 1, from_seq=ROWS, to_seq=2 * ROWS, from_ns=at_ns, to_ns=at_ns + NS)
    found = gaps(archive, robot, file)
    assert said(found) == [("refused", ROWS), (TO_COME, ROWS)]
    assert (found[0].from_ns, found[0].to_ns) == (at_ns, at_ns + NS + 1)
    assert found[1].from_ns >= found[0].to_ns - 1


def test_the_last_file_lies_before_the_next_run_and_its_coming(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = recorded(archive, tmp_path, 0, 1, 2, 3)
    (found,) = gaps(archive, robot, refused(robot, 4))
    assert (found.count, found.to_ns) == (None, CAME_NS)
    assert T0_NS < found.from_ns < T0_NS + 3 * NS
    next_ns = T0_NS + 64 * NS
    robot.record(400, files=1, at_ns=next_ns - 4 * NS)
    robot.hand_in(archive, next(p for p in robot.files() if p.name.startswith("000002")))
    (found,) = (gap for gap in gaps(archive, robot, refused(robot, 4)) if gap.run == 1)
    assert found.to_ns == pytest.approx(next_ns, abs=NS)


def test_a_run_of_which_nothing_else_came_has_no_time(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = recorded(archive, tmp_path, 0, 1, 2, 3, 4)
    assert gaps(archive, robot, RefusedFile("main", 9, 0, "journal/x.mcap", "", CAME_NS)) == []
