"""A ring in another folder, such as in memory: linked, created again after a restart,
moved back.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import amberbox
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.recorder.recorder import Recorder, place_ring, writers_elsewhere
from amberbox.blackbox.store.store import Store, create_store
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Batch
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import COUNT, ManualBox, number, recording

RING = [TopicOptions("/count", keep="ring")]


def box_with(store: Store, first: int, files: int = 3) -> ManualBox:
    box = ManualBox(store.path, RING, options=PipelineOptions(ring_rotate_ns=NS))
    for n in range(first, first + 10 * files):
        box.hear(COUNT, number(n))
        box.write()
    return box


def values(store: Store) -> list[int]:
    return sorted(amberbox.open(store.path).query("ros_count").values("data"))


def test_the_ring_is_written_read_and_followed_through_the_link(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    place_ring(store, tmp_path / "memory")
    box = box_with(store, 0)
    target = tmp_path / "memory" / store.id / "ring"
    assert store.folder("ring").readlink() == target
    assert len(list(target.glob("*.mcap"))) >= 3
    assert (target / "head").exists()
    followed = [d for d in follow(store.path, live=False) if isinstance(d, Batch)]
    assert sum(len(d) for d in followed if d.item == "ros_count") == 30
    box.close()
    assert values(store) == list(range(30))
    assert store.next_run() == 2


def test_a_folder_that_is_gone_after_a_restart_is_made_again(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    place_ring(store, tmp_path / "memory")
    box_with(store, 0).close()
    shutil.rmtree(tmp_path / "memory")
    place_ring(store, tmp_path / "memory")
    box_with(store, 100).close()
    assert values(store) == list(range(100, 130))


def test_a_ring_that_moves_takes_its_files_along(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    box_with(store, 0).close()
    for place in (tmp_path / "a", tmp_path / "b", None):
        place_ring(store, place)
        assert values(store) == list(range(30))
        assert store.folder("ring").is_symlink() == (place is not None)
    assert not list((tmp_path / "a").rglob("*.mcap"))
    assert not list((tmp_path / "b").rglob("*.mcap"))


def test_a_move_home_that_was_broken_off_is_finished(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    box_with(store, 0).close()
    place_ring(store, tmp_path / "memory")
    moving = store.path / "ring.moving"
    moving.mkdir()
    first, *_ = sorted(store.folder("ring").glob("*.mcap"))
    shutil.move(first, moving / first.name)
    place_ring(store, None)
    assert values(store) == list(range(30))


def test_only_another_device_counts_as_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = create_store(tmp_path / "store")
    assert writers_elsewhere(store) == set()
    place_ring(store, tmp_path / "memory")
    assert writers_elsewhere(store) == set()
    other = next(p for p in map(Path, ("/dev/shm", "/proc")) if p.is_dir())
    if other.stat().st_dev == store.path.stat().st_dev:
        other = Path("/proc")
    shutil.rmtree(tmp_path / "memory")
    store.folder("ring").unlink()
    store.folder("ring").symlink_to(other)
    assert writers_elsewhere(store) == {"ring"}


def test_a_place_that_cannot_be_written_is_an_error_with_a_hint(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    (tmp_path / "file").write_text("")
    with pytest.raises(AmberboxError, match="cannot keep the ring in") as error:
        place_ring(store, tmp_path / "file")
    assert "store.ring_path" in (error.value.hint or "")


def test_robot_yaml_says_where_the_ring_lies(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text(
        f"id: r\nstore: {{ring_path: {os.path.relpath(tmp_path / 'memory', folder)}}}\n"
    )
    (folder / "black_box.yaml").write_text(
        "- sim: {topics: [{name: odom, keep: ring}, {name: wifi}]}\n"
    )
    with recording(folder) as recorder:
        wait_until(lambda: _kept(recorder) > 5, "messages")
    store = recorder.store
    found = list((tmp_path / "memory" / store.id / "ring").glob("*.mcap"))
    assert len(found) == 1
    assert len(amberbox.open(store.path).query("sim_odom")) > 5


def _kept(recorder: Recorder) -> int:
    item = recorder.pipeline.items.get("sim_odom")
    return item.counters.kept if item else 0
