"""Segments: damage, half-built ones, a lost manifest; every row stays there once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.store import catalogue as query
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store import segment_builder as segments
from amberbox.blackbox.store.catalogue import read_catalogue
from amberbox.blackbox.store.journal_reader import journals
from amberbox.core.clock import NS
from amberbox.testing.records import BATTERY, T0_NS, FakeRun, build_segments_of, fill_store


def values_of(store: Path) -> list[float]:
    return amberbox.open(store).query("odom", ["x"]).values("pose_x")


EXPECTED = [float(n) for n in range(300)]


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[200:600] = bytes(400)
    path.write_bytes(content)


def test_a_damaged_segment_is_replaced_by_its_journal(tmp_path: Path) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    for path in (tmp_path / "segments/odom").iterdir():
        damage(path)
    table = amberbox.open(tmp_path).query("odom", ["x"])
    assert table.values("pose_x") == EXPECTED
    assert len(table.notes) == 2
    assert all("its journal was read instead" in note for note in table.notes)


def test_a_damaged_segment_without_journal_is_a_named_loss(tmp_path: Path) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    first = journals(tmp_path)[0]
    first.path.unlink()
    damage(next(p for p in (tmp_path / "segments/odom").iterdir() if first.path.stem in p.name))
    table = amberbox.open(tmp_path).query("odom", ["x"])
    assert table.values("pose_x") == EXPECTED[100:]
    assert any("100 rows are lost" in note for note in table.notes)


def test_building_stopped_half_way_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_store(tmp_path)

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(mf, "append", refuse)
        with pytest.raises(OSError, match="No space"):
            build_segments_of(tmp_path)
    assert values_of(tmp_path) == EXPECTED
    build_segments_of(tmp_path)
    assert values_of(tmp_path) == EXPECTED
    assert len(mf.read(tmp_path).segments["odom"]) == 2


@pytest.mark.parametrize("lost", range(6))
def test_any_torn_manifest_gives_every_row_once(tmp_path: Path, lost: int) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    path = tmp_path / mf.NAME
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[: len(lines) - lost])[: -1 if lost else None])
    assert values_of(tmp_path) == EXPECTED
    build_segments_of(tmp_path)
    assert values_of(tmp_path) == EXPECTED


@pytest.mark.parametrize("raw_gone", [False, True])
@pytest.mark.parametrize("joined", [False, True])
def test_a_lost_manifest_is_rebuilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, raw_gone: bool, joined: bool
) -> None:
    fill_store(tmp_path)
    build_segments_of(tmp_path)
    before = mf.read(tmp_path)
    if joined:
        monkeypatch.setattr(segments, "MERGE_COUNT", 2)
        copies = {p: p.read_bytes() for p in (tmp_path / "segments").glob("*/*")}
        segments.merge_small(tmp_path)
        for path, content in copies.items():  # as if the crash came before they were deleted
            path.write_bytes(content)
    if raw_gone:
        for journal in [j for j in journals(tmp_path) if j.finished]:
            journal.path.unlink()
    (tmp_path / mf.NAME).unlink()
    (tmp_path / "segments/odom/broken.parquet").write_bytes(b"PAR1")
    mf.restore(tmp_path)
    assert values_of(tmp_path) == EXPECTED
    build_segments_of(tmp_path)
    assert mf.read(tmp_path).schemas.keys() == before.schemas.keys()
    assert values_of(tmp_path) == EXPECTED
    segments.remove_leftovers(tmp_path)
    assert values_of(tmp_path) == EXPECTED
    if joined and raw_gone:
        left = list((tmp_path / "segments/odom").glob("*+2.parquet"))
        assert len(left) == 1


def test_a_record_that_moves_on_is_looked_at_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between reading the manifest and the segments, the keeper builds and deletes."""
    fill_store(tmp_path)
    looked: list[Path] = []

    def look_and_move_on(store: Path, *, with_segments: bool = True) -> Any:
        catalogue = real(store, with_segments=with_segments)
        if not looked:
            finished = [journal for journal in journals(store) if journal.finished]
            build_segments_of(store)
            for journal in finished:
                journal.path.unlink()
        looked.append(store)
        return catalogue

    real: Callable[..., Any] = read_catalogue
    monkeypatch.setattr(query, "read_catalogue", look_and_move_on)
    assert values_of(tmp_path) == EXPECTED
    assert len(looked) == 2


def test_slow_items_do_not_fill_the_disk_with_files(tmp_path: Path) -> None:
    run = FakeRun(tmp_path)
    for number in range(40):
        run.write([(T0_NS + number * NS, BATTERY, {"volts": float(number)})])
        run.rotate()
        build_segments_of(tmp_path)
        segments.merge_small(tmp_path)
    run.close()
    assert len(list((tmp_path / "segments/battery").iterdir())) <= segments.MERGE_COUNT
    assert amberbox.open(tmp_path).query("battery").values("volts") == [float(n) for n in range(40)]
