"""The watcher: the same findings as a replay, whatever happens to it and to the record."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.monitoring.watcher.stand import PROBE, Stand, kill, line_of, plan_of, written


def test_live_and_replay_give_the_same_bytes(tmp_path: Path) -> None:
    stand = Stand(tmp_path / "store", 1)
    stand.tick()
    watcher = stand.watcher()
    for _ in range(200):
        stand.tick()
        if stand.random.random() < 0.5:
            watcher.step()
    stand.box.close()
    watcher.step()
    watcher.close()
    live = written(stand.path)
    assert len(live) > 200
    assert live == stand.replayed()
