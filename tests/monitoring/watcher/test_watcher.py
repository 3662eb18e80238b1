"""The watcher: the same findings as a replay, whatever happens to it and to the record."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from amberbox.blackbox.store.derived_journal import DerivedJournal
from tests.monitoring.watcher.stand import PROBE, Stand, kill, written


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


@pytest.mark.parametrize("seed", range(3))
def test_killed_at_any_moment_nothing_is_lost_or_doubled(tmp_path: Path, seed: int) -> None:
    """The recorder restarts, crashes, its clock is set; the watcher is killed amid all this."""
    stand = Stand(tmp_path / "store", seed)
    rng = stand.random
    stand.tick()
    watcher = stand.watcher()
    watcher.step()
    for _ in range(120):
        what = rng.random()
        if what < 0.02:
            stand.restart(clean=rng.random() < 0.5)
        elif what < 0.03:
            stand.clock.step(rng.choice([-3600, -1.5, 0.3, 2, 3600]) + rng.uniform(0, 0.01))
        elif what < 0.06:
            kill(watcher)
            watcher = stand.watcher()
        elif what < 0.08:
            watcher.close()
            watcher = stand.watcher()
        elif what < 0.15:
            watcher.measured(PROBE, {"subject": PROBE.subject, "ok": rng.random() < 0.7})
        stand.tick()
        if rng.random() < 0.5:
            watcher.step()
    stand.box.close()
    watcher.step()
    watcher.close()
    live, replayed = written(stand.path), stand.replayed()
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
