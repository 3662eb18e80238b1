"""The worker is killed at random moments: no row is lost, none is doubled."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from amberbox.blackbox.query.record import LocalRecord
from amberbox.core.errors import AmberboxError
from amberbox.server.archive.commit import leftovers
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.worker import ArchiveWorker
from tests.server.archive.recordings import Robot, positions

_KEYS = ["seq", "pose_x"]


def test_killed_at_any_step_nothing_is_lost_or_doubled(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robots = [Robot(name, tmp_path) for name in ("new", "old")]
    for robot in robots:
        robot.record(0, files=4)
        robot.hand_in_all(archive)
    command = [sys.executable, "-m", "tests.server.archive.dying", str(archive.layout.folder)]
    done = subprocess.run(
        [*command, "1", "9"], capture_output=True, text=True, check=True, timeout=100
    )
    *ends, last = map(int, done.stdout.split())
    assert last == 0, done.stderr
    assert ends.count(-signal.SIGKILL) >= 6, done.stderr
    assert set(ends) <= {-signal.SIGKILL, 0}
    theirs = LocalRecord(robots[0].store).query("odom", _KEYS)
    assert positions(archive.robot("new").query("odom", _KEYS)) == positions(theirs)
    assert archive.robot("new").query("odom__units").rows() is not None
    assert len(archive.robot("old").query("odom")) == 0
    runs = archive.robot("old").query("amberbox_run", ["run"])
    assert len(runs) == 4  # what the box says of itself stays
    table = archive.robot("new").envelope("odom", ["pose_x"], points=3)
    assert sum(table.values("pose_x:count")) == 160
    assert list(leftovers(archive.layout, archive.catalogue.schemas())) == []
    kept = sorted(path.parts[-4] for path in archive.layout.journals.rglob("*.mcap"))
    assert kept == ["new"] * 4


def test_a_worker_that_is_killed_over_a_commit_is_started_again(
    archive: FolderArchive, tmp_path: Path
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=6, rows=200)
    robot.hand_in_all(archive)
    with closing(ArchiveWorker(archive.layout.folder)) as worker:
        worker.sweep()  # it is up
        (first,) = worker.pids
        killer = threading.Timer(0.15, os.kill, (first, signal.SIGKILL))
        killer.start()
        try:
            while worker.pids == [first]:
                worker.commit(0.0)
                time.sleep(0.01)
        except AmberboxError as error:
            assert error.hint == "ask again"  # it may also die between two requests
        killer.join()
        worker.commit(0.0)
        assert worker.pids != [first]
        with pytest.raises(AmberboxError, match="knows no 'dance'"):
            worker.ask("dance")
        with (
            closing(ArchiveWorker(archive.layout.folder)) as second,
            pytest.raises(AmberboxError, match="ended with 2"),
        ):
            second.commit()
    ours = archive.robot("r1").query("odom", _KEYS)
    assert positions(ours) == positions(LocalRecord(robot.store).query("odom", _KEYS))
    assert len(ours) == 1200


class _PowerCutError(Exception):
    """Everything ends here."""


def test_files_joined_between_a_cut_and_its_repair_are_not_doubled(
    archive: FolderArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot("r1", tmp_path)
    robot.record(0, files=2)
    first, second = robot.files()
    robot.hand_in(archive, first)
    archive.commit(0.0)
    robot.hand_in(archive, second)
    monkeypatch.setattr(archive.catalogue, "finish", _power_cut)
    with pytest.raises(_PowerCutError):
        archive.commit(0.0)
    monkeypatch.undo()
    monkeypatch.setattr("amberbox.server.archive.commit.COUNT", 2)
    assert archive.compact() > 0
    assert archive.commit(0.0).journals == 1
    ours = archive.robot("r1").query("odom", _KEYS)
    assert positions(ours) == positions(LocalRecord(robot.store).query("odom", _KEYS))
    archive.sweep()
    assert len(archive.robot("r1").query("odom")) == 80


def _power_cut(*_: object) -> None:
    raise _PowerCutError
