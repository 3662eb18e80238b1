"""The keeper keeps on: one journal it cannot build, or another keeper beside it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import maintenance as module
from amberbox.blackbox.retention.maintenance import RetentionService, seal
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.manifest_entries import Segment
from amberbox.blackbox.store.segment_builder import build_segments
from amberbox.blackbox.store.store import WriterLock, open_store
from amberbox.core.clock import NS
from tests.support.manual_recorder import COUNT, ManualBox, number

pytest.importorskip("pyarrow", reason="segments are Parquet files")


def recorded(store: Path) -> ManualBox:
    box = ManualBox(store, options=PipelineOptions(rotate_ns=NS))
    for n in range(30):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    return box


def test_a_journal_that_cannot_be_built_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    box = recorded(tmp_path / "store")
    build = build_segments

    def fail(
        store: Path, journal: JournalFile, make_room_if_due: Callable[[], None]
    ) -> list[Segment]:
        if journal.number == 1:
            raise NotImplementedError("no such type in Arrow")
        return build(store, journal)

    monkeypatch.setattr(module, "build_segments", fail)
    keeper = RetentionService(open_store(box.store), RetentionOptions(ring_s=300.0))
    keeper.step(threading.Event())
    keeper.step(threading.Event())
    numbers = sorted(name.split("-")[-1] for name in manifest.read(box.store).journals)
    assert numbers == ["0000.mcap", "0002.mcap", "0003.mcap"]
    assert capsys.readouterr().err.count("no such type in Arrow") == 1


def test_an_import_leaves_a_keeper_that_is_at_work_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = recorded(tmp_path / "store")
    monkeypatch.setattr(module, "LOCK_TIMEOUT_S", 0.0)
    lock = WriterLock(open_store(box.store), "keeper")
    seal(open_store(box.store))
    assert not manifest.read(box.store).journals
    lock.release()
    seal(open_store(box.store))
    assert len(manifest.read(box.store).journals) == 4
