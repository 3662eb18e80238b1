"""A disk that does not sync: one event, and a new file for later messages."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from amberbox.blackbox.journal import writer
from amberbox.blackbox.recorder.recorder import Syncer
from tests.support.manual_recorder import COUNT, ManualBox, events, number, raw_messages


def sync(syncer: Syncer) -> None:
    syncer.at_once(1.0)
    syncer.sync_if_due()
    syncer.stop()


def test_a_failed_sync_begins_a_new_file_and_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fails = threading.Event()
    fdatasync = os.fdatasync

    def failing(fd: int) -> None:
        if fails.is_set():
            raise OSError(5, "Input/output error")
        fdatasync(fd)

    box = ManualBox(tmp_path / "store")
    monkeypatch.setattr(os, "fdatasync", failing)
    syncer = Syncer(box.pipeline, 1.0)
    for n in range(9):
        fails.set() if 3 <= n < 6 else fails.clear()
        box.hear(COUNT, number(n))
        box.write()
        sync(syncer)
    box.close()
    assert len(list((box.store / "journal").glob("*.mcap"))) == 2
    assert raw_messages(box.store, "/count") == [number(n) for n in range(9)]
    assert [e["text"] for e in events(box.store, "disk")] == [
        "the disk does not sync: Input/output error; what came since the last sync may be lost, "
        "new files begin",
        "the disk syncs again",
    ]


def test_what_does_not_fit_whole_is_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(0))
    box.write()
    (path,) = (box.store / "journal").glob("*.mcap")
    sizes = []

    def expect_room(fd: int, size: int) -> None:
        sizes.append(size)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "_expect_room", expect_room)
    before = path.read_bytes()
    box.hear(COUNT, number(1))
    box.write()
    assert sizes
    assert path.read_bytes() == before
    monkeypatch.undo()
    box.write()
    box.close()
    assert raw_messages(box.store, "/count") == [number(0), number(1)]


@pytest.mark.parametrize(
    ("blocks", "free", "refused"), [(10, 1, True), (10, 3, False), (0, 0, False)]
)
def test_room_is_asked_of_the_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, blocks: int, free: int, refused: bool
) -> None:
    class Status:
        f_blocks, f_bavail, f_frsize = blocks, free, 4096

    monkeypatch.setattr(os, "fstatvfs", lambda fd: Status)
    if refused:
        with pytest.raises(OSError, match="No space"):
            writer._expect_room(0, 5000)
    else:
        writer._expect_room(0, 5000)
