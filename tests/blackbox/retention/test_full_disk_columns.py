"""Columns on a disk without room: they wait, and the keeper lives on."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import maintenance as keeper_module
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from tests.support.manual_recorder import COUNT, ManualBox, number

pytest.importorskip("pyarrow", reason="columns need it; pip install 'amberbox[keep]'")


def no_room(*_: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_columns_are_made_and_joined_once_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_ns=NS))
    for n in range(90):
        box.hear(COUNT, number(n))
        box.write()
    box.close()
    keeper = RetentionService(open_store(box.store), RetentionOptions(min_free=0))
    with monkeypatch.context() as full:
        full.setattr(keeper_module, "build_segments", no_room)
        keeper.build(threading.Event())
    assert not mf.read(box.store).journals
    with monkeypatch.context() as full:
        full.setattr(keeper_module, "merge_small", no_room)
        keeper.build(threading.Event())
    keeper.close()
    known = mf.read(box.store)
    assert len(known.journals) == len(list((box.store / "journal").glob("*.mcap")))
    assert capsys.readouterr().err == ""


def test_a_broken_disk_is_no_full_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write()
    box.close()
    monkeypatch.setattr(keeper_module, "merge_small", broken)
    keeper = RetentionService(open_store(box.store), RetentionOptions(min_free=0))
    with pytest.raises(OSError, match="Input/output"):
        keeper.build(threading.Event())
