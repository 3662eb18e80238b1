"""The watcher: the same findings as a replay, whatever happens to it and to the record."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from amberbox.blackbox.store.derived_journal import DerivedJournal
from tests.monitoring.watcher.stand import Stand, late_plan, plan_of, written


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


@pytest.mark.parametrize(("seed", "late_s"), [(0, 0), (1, 0), (2, 0), (3, 2), (4, 5)])
def test_killed_at_any_moment_nothing_is_lost_or_doubled(
    tmp_path: Path, seed: int, late_s: float
) -> None:
    """The recorder restarts, crashes, its clock is set; the watcher is killed amid all this.

    Messages come late, as their source is held up.
    """
    stand = Stand(tmp_path / "store", seed, late_s=late_s)
    plan = late_plan() if late_s else plan_of()
    jumps_s = [-3600, -1.5, 0.3, 2, 3600]
    stand.watch_with_kills(120, jumps_s, killed=0.03, ended=0.02, measured=0.07, plan=plan)
    live, replayed = written(stand.path), stand.replayed(plan)
    assert len(replayed) > 100
    assert live == replayed


def test_what_the_disk_refuses_is_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand = Stand(tmp_path / "store", 20)
    stand.tick()
    watcher = stand.watcher()
    for number in range(90):
        stand.tick()
        if number % 30 == 20:
            with monkeypatch.context() as patched:
                patched.setattr(DerivedJournal, "append", _refuse)
                with pytest.raises(OSError, match="No space"):
                    watcher.step()
            watcher.close()
            watcher = stand.watcher()
        watcher.step()
    stand.box.close()
    watcher.step()
    watcher.close()
    assert written(stand.path) == stand.replayed()


def _refuse(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")
