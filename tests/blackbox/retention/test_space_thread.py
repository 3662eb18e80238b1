"""The keeper at rest, and the thread that makes room: little work, and no silent end."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from amberbox.blackbox.retention import usage
from amberbox.blackbox.retention.deletion import Deleter
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.usage import Allowance, SpaceStatement
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.store import open_store
from amberbox.testing.clock import PATIENCE_S
from tests.support.manual_recorder import COUNT, ManualBox, number

OPTIONS = RetentionOptions(quota=50_000_000, min_free=0)


def test_a_keeper_looks_for_work_only_where_something_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = ManualBox(tmp_path / "store")
    box.hear(COUNT, number(1))
    box.write()
    keeper = RetentionService(open_store(box.store), OPTIONS)
    for _ in range(3):
        keeper.step(threading.Event())
    built: list[int] = []
    monkeypatch.setattr(keeper, "build", lambda stop: built.append(1))
    keeper.step(threading.Event())
    assert built == []
    box.close()
    keeper.step(threading.Event())
    assert built == [1]
    keeper.close()


def test_what_ends_the_thread_ends_the_keeper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()

    def make_room_if_due(deleter: Deleter) -> None:
        looked.set()
        raise RuntimeError("a defect")

    monkeypatch.setattr(Deleter, "make_room_if_due", make_room_if_due)
    ManualBox(tmp_path / "store").close()
    keeper = RetentionService(open_store(tmp_path / "store"), OPTIONS)
    keeper.start_space_thread()
    assert looked.wait(PATIENCE_S)
    assert keeper._room is not None
    keeper._room.stop()
    with pytest.raises(RuntimeError, match="a defect"):
        keeper.step(threading.Event())


def test_what_was_written_since_the_keeper_looked_is_not_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = [100]
    monkeypatch.setattr("time.monotonic_ns", lambda: now_ns[0])
    left = Allowance(tmp_path)
    assert left.left_bytes(10) is None
    now_ns[0] = 200
    assert left.left_bytes(40) is None
    usage.publish_statement(
        tmp_path, SpaceStatement(1000, 0, looked_ns=150)
    )  # it was held up after its look
    assert left.left_bytes(50) == 1000 - (50 - 10)
    now_ns[0] = 300
    assert left.left_bytes(90) == 1000 - (90 - 10)
    usage.publish_statement(tmp_path, SpaceStatement(900, 0, looked_ns=300))
    now_ns[0] = 310
    assert left.left_bytes(95) == 900 - 5


def test_a_statement_of_a_run_before_counts_from_the_start(tmp_path: Path) -> None:
    usage.publish_statement(tmp_path, SpaceStatement(1000, 0, looked_ns=1 << 62))
    left = Allowance(tmp_path)
    assert left.left_bytes(0) == 1000
    assert left.left_bytes(300) == 700
