"""The keeper deletes during an export: the remaining data are exported, with a note."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.journal.chunk import Buffer, open_buffer
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import View
from amberbox.blackbox.query.foxglove import MessageFrames
from amberbox.blackbox.store import catalogue, journal_reader, own_records
from amberbox.blackbox.store.journal_reader import JournalFile, journal_file
from tests.blackbox.query.conftest import record_robot


def delete_at_look(monkeypatch: pytest.MonkeyPatch, store: Path, number: int) -> list[int]:
    """Delete the oldest journal just before a journal is looked into or read, the nth time."""
    looks: list[int] = []

    def look() -> None:
        looks.append(len(looks))
        if len(looks) == number:
            min((store / "journal").glob("*.mcap")).unlink()

    def looking(path: Path, name: str = "") -> JournalFile:
        look()
        return journal_file(path, name)

    def reading(path: Path) -> AbstractContextManager[Buffer]:
        look()
        return open_buffer(path)

    monkeypatch.setattr(catalogue, "journal_file", looking)
    for module in (journal_reader, own_records):
        monkeypatch.setattr(module, "open_buffer", reading)
    return looks


@pytest.mark.parametrize("form", ["csv", "mcap", "mcap-json", "bag"])
@pytest.mark.parametrize("number", [4, 6, 8])
def test_a_journal_that_goes_is_named_and_the_rest_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str, number: int
) -> None:
    store, target = tmp_path / "store", tmp_path / ("out.csv" if form == "csv" else "out")
    record_robot(store, rotate_s=1).close()
    record = amberbox.open(store)
    looks = delete_at_look(monkeypatch, store, number)
    report = export(record, View(items=["ros_text"]), target, form)
    assert len(looks) >= number and target.exists()
    (missing,) = report.missing
    assert missing.endswith("was deleted while it was being exported")
    left = amberbox.open(store).query("ros_text")
    assert report.counts == {"ros_text": len(left)} and len(left) < 30


def test_playback_seeks_after_files_were_deleted(tmp_path: Path) -> None:
    store = tmp_path / "store"
    record_robot(store, rotate_s=1).close()
    record = amberbox.open(store)
    frames = MessageFrames(record, (), (None, None))
    assert len(frames.topics) == 3
    min((store / "journal").glob("*.mcap")).unlink()
    last_ns = record.last_ns()
    assert last_ns is not None
    assert [frame.topic.name for frame in frames.latched(last_ns)] == ["/map_name"]
    assert len(list(frames.read(0))) > 20
