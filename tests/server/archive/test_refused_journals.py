"""What does not hold is refused whole: no row of it is in any table, the file stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.archive.folder import FolderArchive
from tests.server.archive.recordings import Robot


@pytest.mark.parametrize("damage", ["flipped", "cut", "longer", "empty", "text"])
def test_a_bad_journal_is_refused_whole(
    archive: FolderArchive, tmp_path: Path, damage: str
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=2)
    bad, good = robot.files()
    content = bad.read_bytes()
    middle = len(content) // 2
    bad.write_bytes(
        {
            "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "cut": content[:middle],
            "longer": content + b"more",
            "empty": b"",
            "text": b"no journal at all\n" * 100,
        }[damage]
    )
    with pytest.raises(AmberboxError, match=bad.name):
        robot.hand_in(archive, bad)
    assert (tmp_path / "upload-r1").exists()
    robot.hand_in(archive, good)
    assert archive.commit().journals == 1
    assert len(archive.robot().query("odom")) == 40


def test_a_journal_of_another_store_or_content_is_refused(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=1)
    (path,) = robot.files()
    key = robot.key(path)
    other = replace(key, store_id="54e456bc-27fe-432b-b1cf-7c1dacec9dfb")
    with pytest.raises(AmberboxError, match="another store"):
        archive.put(other, path)
    with pytest.raises(AmberboxError, match="not what was announced"):
        archive.put(replace(key, sha256="0" * 64), path)
    assert path.exists()


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("robot", "../r1"), ("robot", ""), ("store_id", ".."), ("file", "../../etc/passwd"),
        ("file", "journal/../000001-00000001-0000.mcap"), ("file", "journal/x.mcap"),
        ("file", "other/000001-00000001-0000.mcap"), ("file", "000001-00000001-0000.mcap"),
    ],
)  # fmt: skip
def test_a_name_never_leads_out_of_the_archive(
    archive: FolderArchive, tmp_path: Path, part: str, value: str
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=1)
    (path,) = robot.files()
    with pytest.raises(UsageError, match="no name of a journal"):
        archive.put(replace(robot.key(path), **{part: value}), path)
    assert not any(archive.layout.journals.iterdir())


def test_a_journal_that_rots_on_the_server_is_left_out_and_said(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=2)
    robot.hand_in_all(archive)
    key = robot.key(robot.files()[0])
    kept = archive.layout.journal("r1", key.store_id, key.file)
    kept.write_bytes(kept.read_bytes()[:-100])
    done = archive.commit()
    assert (done.journals, done.refused) == (1, 1)
    assert len(archive.robot().query("odom")) == 40
    (gap,) = archive.robot().gaps()
    assert gap.reason == f"refused: {key.file}: the file changed after it was verified"
    assert gap.count == 81  # 40 poses, 40 batteries, what the run is
    assert robot.hand_in(archive, robot.files()[0]).is_new
    assert archive.commit(0.0).journals == 1
    assert len(archive.robot().query("odom")) == 80
    assert archive.robot().gaps() == []


def test_a_robot_that_is_not_here_is_named(archive: FolderArchive, tmp_path: Path) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=1)
    robot.hand_in_all(archive)
    archive.commit()
    with pytest.raises(UsageError, match="nothing of r2") as caught:
        archive.robot("r2").query("odom")
    assert caught.value.hint == "there are: r1"
