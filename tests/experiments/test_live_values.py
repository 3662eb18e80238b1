"""What is true of a robot now, by a record that is being written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.store import WriterLock, open_store
from amberbox.core.expression import parse
from amberbox.experiments.live_values import LiveValues
from amberbox.testing.records import FakeItem, FakeRun

S = 1_000_000_000
T0 = 1_700_000_000 * S


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Path]:
    """Return a store with 30 s of a battery, and a status at its end; its recorder runs."""
    path = tmp_path / "store"
    battery = FakeItem("battery", [{"volts": 1.5}])
    run = FakeRun(path, items=[battery])
    lock = WriterLock(open_store(path), "main")
    run.start(T0 - 1)
    run.write([(T0 + n * S, battery, {"volts": 24.0 + n}) for n in range(30)])
    watch = FakeRun(path, writer="watch")
    watch.own(channels.STATUS, T0 + 29 * S, {
        "robot": "r", "component": "safety", "mode": "", "level": "ok", "state": "", "outputs": [],
        "blocked_by": [], "measured_ns": T0, "since_ns": T0, "reason": "", "config_hash": "",
    })  # fmt: skip
    yield path
    lock.release()
    run.close()
    watch.close()


def test_newest_values_statuses_and_windows(store: Path) -> None:
    live = LiveValues(store)
    assert live("battery.volts") == 53.0
    for text, value in (
        ("battery.volts > least and status(safety) == 'ok'", True),
        ("status(safety) == 'error'", False),
        ("min(battery.volts over 5s) > 40", True),
        ("max(battery.volts over 20s) - min(battery.volts over 20s) > 18", True),
        ("battery.amps > 1", None),
        ("status(laser) == 'ok'", None),
    ):
        assert live.value(parse(text), {"least": 50}) is value, text
    assert live.value(parse("least > 40"), {"least": 50}) is True


def test_without_a_recorder_everything_is_unknown(store: Path, tmp_path: Path) -> None:
    lock = store / "lock.main"
    lock.rename(store / "lock.other")  # the lock is held, but of another writer
    assert LiveValues(store)("battery.volts") is None
    assert LiveValues(tmp_path / "nothing")("battery.volts") is None
