"""One journal never stops the archive: it is tried alone, refused and reported; others continue."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.server.archive import commit
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.worker import MEMORY_BYTES, ArchiveWorker, WorkFailedError, serve
from amberbox.server.schema import EVENT
from amberbox.testing.clock import ManualClock
from amberbox.testing.records import POSE, T0_NS, FakeItem, FakeRun, pose
from tests.server.archive.recordings import Robot

DEADLY = "tests.server.archive.deadly"


def bring(archive: FolderArchive, folder: Path, name: str, *items: str) -> Robot:
    """Have a robot hand in a journal with poses, and with other items."""
    robot = Robot(name, folder)
    others = [FakeItem(item, [{"a": 1}]) for item in items]
    run = FakeRun(robot.store, items=[POSE, *others])
    for number in range(5):
        at = T0_NS + number * NS
        run.write([(at, POSE, pose(number)), *((at, item, {"a": number}) for item in others)])
    run.close()
    robot.hand_in_all(archive)
    return robot


def committed(archive: FolderArchive, worker: ArchiveWorker, done: Callable[[], bool]) -> list[str]:
    """Commit as the server does until something is true; return over which journals it failed."""
    failed: list[str] = []
    while not done():
        assert len(failed) < 12, failed
        try:
            worker.commit(0.0)
        except WorkFailedError as error:
            failed.append(error.journal)
            archive.note_failure(error.journal, error.what)
    return failed


def states(archive: FolderArchive) -> dict[str, str]:
    return {row.robot: row.state for row in archive.catalogue.journals()}


@contextmanager
def deadly(archive: FolderArchive, step_s: float = 60.0) -> Iterator[ArchiveWorker]:
    worker = ArchiveWorker(archive.layout.folder, step_s=step_s, program=DEADLY)
    try:
        yield worker
    finally:
        worker.close(0.1)


def answered(archive: FolderArchive) -> dict[str, Any]:
    """Have a worker in this process commit; return its answer."""
    answers = io.StringIO()
    serve(archive.layout.folder, io.StringIO('{"op":"commit","every_s":0}\n'), answers)
    found: dict[str, Any] = json.loads(answers.getvalue().splitlines()[-1])
    return found


@pytest.mark.parametrize("error", [KeyError("what nobody foresaw"), MemoryError()])
def test_whatever_a_journal_does_is_told(
    archive: FolderArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    bring(archive, tmp_path, "a")
    monkeypatch.setattr(commit, "flats_of", Mock(side_effect=error))
    answer = answered(archive)
    assert answer["failed"] and type(error).__name__ in answer["error"]


def test_a_disk_that_takes_nothing_is_no_journals_fault(
    archive: FolderArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bring(archive, tmp_path, "a")
    monkeypatch.setattr(commit, "flats_of", Mock(side_effect=RuntimeError("a library's words")))
    (archive.layout.tables / ".probe").mkdir()  # no file can be written there
    answer = answered(archive)
    assert "failed" not in answer and "look at the disk" in answer["hint"]


def test_a_worker_has_limits_of_time_and_memory(archive: FolderArchive, tmp_path: Path) -> None:
    bring(archive, tmp_path, "b", "lasts")
    with deadly(archive, step_s=1.0) as worker:
        worker.sweep()  # it is up
        limits = Path(f"/proc/{worker.pids[0]}/limits").read_text()
        with pytest.raises(WorkFailedError, match="took more than 1 s") as caught:
            worker.commit(0.0)
    assert caught.value.journal.startswith("b/")
    (size,) = re.findall(r"Max data size +(\d+)", limits)
    assert 2 << 30 <= int(size) <= MEMORY_BYTES


def test_the_culprit_is_refused_and_all_others_are_committed(
    archive: FolderArchive, tmp_path: Path
) -> None:
    why = "ended with -9"
    for name in ("a", "b", "z"):
        bring(archive, tmp_path, name, *(["kills"] if name == "b" else []))
    wanted = {"a": "committed", "b": "refused", "z": "committed"}
    with deadly(archive) as worker:
        failed = committed(archive, worker, lambda: states(archive) == wanted)
    assert len(failed) == 4, "twice with others, twice alone"
    assert all(name.startswith("b/") for name in failed)
    assert len(archive.robot("a").query("odom")) == len(archive.robot("z").query("odom")) == 5
    (gap,) = archive.robot("b").gaps()
    assert why in gap.reason and gap.reason.startswith("refused: journal/")
    with archive.catalogue.database.reading() as connection:
        (event,) = connection.execute(select(EVENT)).all()
    assert (event.robot, event.kind) == ("b", commit.KIND)
    assert "amberbox verify" in event.text and why in event.text
    assert commit.load_suspects(archive.catalogue) == commit.Suspects()


def test_what_one_version_refused_is_tried_by_the_next(
    archive: FolderArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bring(archive, tmp_path, "a")
    monkeypatch.setattr(commit, "flats_of", Mock(side_effect=KeyError("a mistake")))
    for _ in range(2 * commit.TRIES):  # also who came alone is tried so twice
        assert states(archive) == {"a": "put"}
        with pytest.raises(KeyError):
            archive.commit(0.0)
        archive.note_failure("", "a mistake of this version")
    monkeypatch.undo()
    assert archive.commit(0.0).refused == 1
    assert archive.try_again() == 0 and states(archive) == {"a": "refused"}
    monkeypatch.setattr(commit, "__version__", "the next one")
    assert archive.try_again() == 1
    assert archive.commit(0.0).journals == 1 and archive.robot().gaps() == []


def test_an_innocent_journal_is_committed_alone(archive: FolderArchive, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        bring(archive, tmp_path, name)
    bring(archive, tmp_path, "waits")
    rows = archive.catalogue.waiting()
    archive.catalogue.plan([row for row in rows if row.robot != "waits"], 0)
    for _ in range(commit.TRIES):
        archive.note_failure("", "the machine had no memory")
    assert archive.commit(0.0).journals == 1  # who is not suspected goes first
    assert states(archive)["waits"] == "committed"
    done = [archive.commit(60.0) for _ in range(3)]
    assert [one.journals for one in done] == [1, 1, 1]
    assert [one.next_in_s for one in done[:2]] == [0, 0]
    assert set(states(archive).values()) == {"committed"}
    assert len(archive.robot().query("odom")) == 20


def test_what_a_failed_batch_had_brought_is_taken_back(
    archive: FolderArchive, tmp_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amberbox.server.archive import delta_files

    for name in ("a", "b"):
        bring(archive, tmp_path, name, "volts")
    change, tables = delta_files.change_table, list[str]()

    def failing(folder: Path, *arguments: object, **named: object) -> None:
        if folder.parent.name == "odom" and "." not in folder.name and not tables:
            raise RuntimeError("a table that cannot be")
        change(folder, *arguments, **named)  # type: ignore[arg-type]  # as it came

    monkeypatch.setattr(delta_files, "change_table", failing)
    for _ in range(commit.TRIES):
        with pytest.raises(RuntimeError):
            archive.commit(0.0)
        archive.note_failure("", "a table that cannot be")
    assert len(archive.robot().query("volts")) == 10, "other tables had their rows already"
    tables.append("well again")
    for left in (1, 0):
        assert archive.commit(0.0).waiting == left
    for item in ("volts", "odom"):
        assert sorted(archive.robot().query(item, ["seq"]).values("robot")) == ["a"] * 5 + ["b"] * 5
    assert archive.catalogue.held(RobotStore("a", archive.catalogue.sources(["a"])[0].store_id))
