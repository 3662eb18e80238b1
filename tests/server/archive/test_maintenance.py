"""Maintenance of the archive: commits of arriving journals, joining, and disk space."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, insert, select

from amberbox.blackbox.store.manifest_entries import Tombstone, to_record
from amberbox.blackbox.store.manifest_lines import FIRST_HASH, encode
from amberbox.core.errors import AmberboxError
from amberbox.link.ledger import LOST
from amberbox.link.uploads import Proof
from amberbox.server import settings
from amberbox.server.archive import maintenance
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.maintenance import RETENTION, ArchiveMaintenance
from amberbox.server.archive.worker import WorkFailedError
from amberbox.server.bus import EventBus, ServerChange
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.ingest.link_state import log_event
from amberbox.server.ingest.uploads import IncomingJournal
from amberbox.server.journals import OWN, Retention
from amberbox.server.schema import ASIDE, BATCHES, COMMITTED, EVENT, ROW, UPLOAD
from amberbox.testing.clock import PATIENCE_S, ManualClock, until
from tests.server.archive.recordings import Robot

_GB = 1 << 30


class Scene:
    """A maintained archive, with a disk whose free space the test sets."""

    def __init__(self, folder: Path, every_s: float = 0.0) -> None:
        folder.mkdir()
        self.clock, self.bus = ManualClock(), EventBus()
        self.database = ServerDatabase(folder / FILE, self.clock)
        self.archive = FolderArchive(folder, self.database, self.clock)
        self.free = 50 * _GB
        self.keeping = ArchiveMaintenance(
            folder, self.database, self.bus, self.clock, self.archive,
            every_s=every_s, usage=lambda _: (100 * _GB, 0, self.free),
        )  # fmt: skip
        self.heard: list[ServerChange] = []
        self.bus.on("committed", self.heard.append)
        self.robot = Robot("r1", folder.parent)

    def count(self, table: Any) -> int:
        with self.database.reading() as connection:
            return connection.execute(select(func.count()).select_from(table)).scalar() or 0

    def early_rows(self, *seqs: int) -> None:
        """Store rows from the link before their journal arrives."""
        about = {"robot": "r1", "store_id": self.robot.store_id, "writer": "main", "run": 1}
        rows = [
            {**about, "seq": seq, "channel": "c", "log_ns": 1, "data": b"", "received_ns": 1}
            for seq in seqs
        ]
        with self.database.begin() as connection:
            connection.execute(insert(ROW), rows)

    def hand_in(self) -> None:
        """Upload the robot's journals."""
        self.robot.hand_in_all(self.archive)
        self.bus.publish(ServerChange("journal", "r1", {"state": "verified"}))

    def play(self, play: Callable[[], Awaitable[None]]) -> None:
        """Run the maintenance beside the actions of a test."""

        async def both() -> None:
            self.bus.attach(asyncio.get_running_loop())
            task = asyncio.create_task(self.keeping.run())
            try:
                await asyncio.wait_for(play(), PATIENCE_S)
            finally:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

        asyncio.run(both())


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    found = Scene(tmp_path / "server")
    yield found
    found.keeping.close()
    found.database.close()


def test_a_journal_is_committed_and_its_early_rows_go(scene: Scene) -> None:
    scene.robot.record(0, files=2)

    async def play() -> None:
        scene.early_rows(0, 5, 10_000)
        await asyncio.to_thread(scene.hand_in)
        await until(lambda: bool(scene.heard))

    scene.play(play)
    assert scene.heard == [ServerChange("committed", data={"robots": ["r1"]})]
    assert len(scene.archive.robot("r1").query("odom", ["pose_x"])) == 80
    with scene.database.reading() as connection:
        assert connection.execute(select(ROW.c.seq)).scalars().all() == [10_000]
        held = connection.execute(select(COMMITTED.c.from_seq, COMMITTED.c.to_seq)).all()
    assert len(held) == 1 and held[0].from_seq == 0, "journals side by side are one stretch"
    assert maintenance.drop_settled_rows(scene.database, scene.clock) == [], (
        "done again it changes nothing"
    )


def test_where_nothing_waits_no_worker_is_started(scene: Scene) -> None:
    async def play() -> None:
        await asyncio.sleep(0.3)

    scene.play(play)
    assert scene.keeping._worker.pids == []


def test_a_worker_that_is_killed_is_started_again(scene: Scene) -> None:
    scene.robot.record(0, files=1)

    async def play() -> None:
        await asyncio.to_thread(scene.keeping._worker.sweep)  # it is up
        os.kill(scene.keeping._worker.pids[0], signal.SIGKILL)
        await asyncio.to_thread(scene.hand_in)
        await until(lambda: bool(scene.heard))

    scene.play(play)
    assert scene.count(BATCHES) == 1 and scene.keeping.troubles() == []


def test_what_a_worker_cannot_do_is_told_and_tried_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.robot.record(0, files=1)
    said: list[list[str]] = []
    works = scene.keeping._worker.commit

    def commit(every_s: float) -> Any:
        if not said:
            said.append([])
            raise AmberboxError("the disk is full", "make room")
        said.append(scene.keeping.troubles())
        return works(every_s)

    monkeypatch.setattr(scene.keeping._worker, "commit", commit)

    async def play() -> None:
        await asyncio.to_thread(scene.hand_in)
        await until(lambda: bool(scene.heard))
        await until(lambda: not scene.keeping.troubles())

    scene.play(play)
    assert said[1] == ["the archive: the disk is full"]


def test_a_journal_that_was_verified_before_a_crash_is_taken_over(scene: Scene) -> None:
    scene.robot.record(0, files=1)
    for path in scene.robot.files():
        _verified(scene, path)

    async def play() -> None:
        await until(lambda: bool(scene.heard))

    scene.play(play)
    assert len(scene.archive.robot("r1").query("odom", ["pose_x"])) == 40


def _verified(scene: Scene, path: Path) -> None:
    """Enter a journal as the upload service does, and die before the archive is notified."""
    key = scene.robot.key(path)
    place = scene.archive.layout.journal(key.robot, key.store_id, key.file)
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, place)
    numbers = dict.fromkeys(("run", "number", "first_seq", "end_seq", "start_ns", "end_ns"), 0)
    row = {
        "robot": key.robot, "store_id": key.store_id, "journal": key.file, "sha256": key.sha256,
        "bytes": 1, "state": "verified", "reason": "", "signed": True, "writer": "main",
        "path": str(place.relative_to(scene.archive.layout.folder)), "began_ns": 0,
        "ended_ns": 0, **numbers,
    }  # fmt: skip
    with scene.database.begin() as connection:
        connection.execute(insert(UPLOAD), [row])


def test_what_a_power_cut_took_is_a_gap(scene: Scene) -> None:
    scene.robot.record(0, files=1)
    about = {"robot": "r1", "store_id": scene.robot.store_id, "writer": "watch", "run": 1}
    rows = [
        {**about, "seq": seq, "sha256": f"{seq:064}", "why": LOST, "channel": "c",
         "log_ns": 1_000 + seq, "data": b"", "at_ns": 1}
        for seq in (7, 8, 9)
    ]  # fmt: skip
    with scene.database.begin() as connection:
        connection.execute(insert(ASIDE), rows)

    async def play() -> None:
        await asyncio.to_thread(scene.hand_in)
        await until(lambda: bool(scene.heard))

    scene.play(play)
    [gap] = [gap for gap in scene.archive.robot("r1").gaps() if "power cut" in gap.reason]
    assert (gap.from_seq, gap.to_seq, gap.count) == (7, 10, 3)


@pytest.mark.parametrize("is_near", [True, False])
def test_what_was_deleted_before_the_copy_is_a_gap_with_its_reason(
    scene: Scene, is_near: bool
) -> None:
    """Whether it is between the journal's seal and its signature, or anywhere else."""
    scene.robot.record(0, files=2)
    scene.hand_in()
    gone = Tombstone(("journal/000002-x-0000.mcap",), "both", "main", 2, 100, 200, 5, 9, "",
                     "no room", False, 10)  # fmt: skip
    others = replace(gone, run=3, confirmed=True), replace(gone, run=4, what="columns")
    records = [to_record(tombstone) for tombstone in (gone, *others)]
    lines = encode(records, FIRST_HASH).decode() + "no line"
    incoming = IncomingJournal("r1", scene.robot.store_id, "", "", 0)
    scene.keeping.note_deleted(incoming, Proof(lines) if is_near else Proof("", lines))
    found = scene.archive.robot("r1").gaps()
    [gap] = [gap for gap in found if "deleted on the robot" in gap.reason]
    assert (gap.run, gap.from_seq, gap.to_seq) == (2, 100, 200) and "no room" in gap.reason


def noted(scene: Scene) -> list[str]:
    with scene.database.reading() as connection:
        return list(connection.scalars(select(EVENT.c.text)))


def test_data_go_by_the_rules_of_the_setting(scene: Scene) -> None:
    scene.robot.record(0, files=3)
    scene.robot.hand_in_all(scene.archive)
    scene.archive.commit(0)
    scene.clock.advance(3 * 24 * 3600)
    with scene.database.begin() as connection:
        rules = [Retention(journals_s=3600.0), Retention(keeping=OWN, columns_s=3600.0)]
        settings.write(connection, 0, RETENTION, rules)
        log_event(connection, "r1", 0, "connected", "long ago")
    before = len(list(scene.archive.layout.journals.rglob("*.mcap")))
    scene.keeping.tidy(is_daily=False)
    assert "long ago" in noted(scene)
    assert len(list(scene.archive.layout.journals.rglob("*.mcap"))) == before
    scene.keeping.tidy(is_daily=True)
    assert "long ago" not in noted(scene)
    assert len(list(scene.archive.layout.journals.rglob("*.mcap"))) < before


def test_data_go_daily_also_where_the_server_is_restarted_more_often(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    daily: list[bool] = []
    monkeypatch.setattr(ArchiveMaintenance, "tidy", lambda _, *, is_daily: daily.append(is_daily))
    monkeypatch.setattr(maintenance, "_FIRST_S", 0.0)
    for hours in (0, 9, 9, 9, 1):
        scene.clock.advance(hours * 3600)
        again = ArchiveMaintenance(
            scene.database.path.parent, scene.database, EventBus(), scene.clock, scene.archive
        )
        asyncio.run(_begun(again, daily, len(daily) + 1))
        again.close()
    assert daily == [True, False, False, True, False]


async def _begun(again: ArchiveMaintenance, daily: list[bool], count: int) -> None:
    running = asyncio.create_task(again.run())
    while len(daily) < count and not running.done():
        await asyncio.sleep(0.01)
    await again._in_thread(lambda: None)  # the same thread has written it down before
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_a_disk_that_fills_is_told_and_takes_nothing_more(scene: Scene) -> None:
    async def look(free: int) -> None:
        scene.free = free
        await scene.keeping._look_at_disk()

    for free in (50 * _GB, 4 * _GB, 3 * _GB, _GB // 2, 60 * _GB):
        asyncio.run(look(free))
        assert scene.keeping.is_full == (free < _GB)
        assert bool(scene.keeping.troubles()) == (free < 5 * _GB)
    with scene.database.reading() as connection:
        events = select(EVENT.c.kind).where(EVENT.c.robot == "").order_by(EVENT.c.number)
        kinds = list(connection.scalars(events))
    assert kinds == ["disk_low", "disk_full", "disk_ok"], "each once"


def test_an_end_does_not_wait_for_a_long_commit(scene: Scene) -> None:
    worker, ended = scene.keeping._worker, list[AmberboxError]()
    worker.sweep()  # it is up
    (pid,) = worker.pids
    os.kill(pid, signal.SIGSTOP)  # as busy as can be

    def commit() -> None:
        with pytest.raises(AmberboxError, match="ended with -9") as caught:
            worker.commit()
        ended.append(caught.value)

    thread = threading.Thread(target=commit)
    thread.start()
    while not worker._pool._now:
        time.sleep(0.01)
    worker.close(0.1)
    thread.join(PATIENCE_S)
    assert ended and not isinstance(ended[0], WorkFailedError)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
