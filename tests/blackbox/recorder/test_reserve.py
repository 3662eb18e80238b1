"""The reserve: real blocks, made when there is room, given up and made whole again."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from amberbox.blackbox.recorder import disk_room as module
from amberbox.blackbox.recorder.disk_room import SPARE_BYTES, DiskRoom

RESERVE = 200_000


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> list[int | None]:
    """Set the free space that the disk reports."""
    said: list[int | None] = [10**9]
    monkeypatch.setattr(module, "free_bytes", lambda folder: said[0])
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)
    return said


def begun(store: Path) -> DiskRoom:
    room = DiskRoom(store, RESERVE)
    room.begin()
    return room


def test_the_reserve_holds_real_blocks(tmp_path: Path) -> None:
    room = begun(tmp_path)
    status = (tmp_path / "reserve").stat()
    assert (status.st_size, room.reason, room.trouble) == (RESERVE, "", "")
    assert status.st_blocks * 512 >= RESERVE


def test_it_is_given_up_once_and_comes_back_with_the_room(
    tmp_path: Path, free: list[int | None]
) -> None:
    room = begun(tmp_path)
    assert room.release()
    assert not room.release()
    for bytes_free, reason in [
        (0, "disk full"),
        (RESERVE + SPARE_BYTES - 1, "disk full"),
        (RESERVE + SPARE_BYTES, ""),
    ]:
        free[0] = bytes_free
        room.update()
        assert room.reason == reason
    assert (tmp_path / "reserve").stat().st_size == RESERVE


def test_the_next_run_knows_that_it_was_given_up(tmp_path: Path, free: list[int | None]) -> None:
    begun(tmp_path).release()
    free[0] = RESERVE
    assert begun(tmp_path).reason == "disk full"


def test_parts_that_the_keeper_took_are_filled_up(tmp_path: Path, free: list[int | None]) -> None:
    room = begun(tmp_path)
    os.truncate(tmp_path / "reserve", 50_000)
    free[0] = 1000
    room.update()
    assert room.reason == ""
    free[0] = 150_000 + SPARE_BYTES
    room.update()
    assert (tmp_path / "reserve").stat().st_size == RESERVE


def test_a_run_on_a_disk_without_a_byte_gives_the_reserve_up(
    tmp_path: Path, free: list[int | None]
) -> None:
    begun(tmp_path)
    free[0] = 0
    assert begun(tmp_path).reason == "disk full"
    assert (tmp_path / "reserve").stat().st_size == 0


def test_a_disk_too_small_for_a_reserve_records_without_one(
    tmp_path: Path, free: list[int | None]
) -> None:
    free[0] = RESERVE
    room = begun(tmp_path)
    assert (room.reason, room.trouble) == ("", "too little room is free")
    assert not room.release()
    assert not (tmp_path / "reserve").exists()


def test_a_disk_that_refuses_the_reserve_says_so(
    tmp_path: Path, free: list[int | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(fd: int, offset: int, length: int) -> None:
        raise OSError(122, "Disk quota exceeded")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    room = begun(tmp_path)
    assert (room.reason, room.trouble) == ("", "Disk quota exceeded")
    assert not (tmp_path / "reserve").exists()


def test_without_a_reserve_only_the_keeper_stops_the_record(
    tmp_path: Path, free: list[int | None]
) -> None:
    room = DiskRoom(tmp_path, 0)
    free[0] = 0
    room.begin()
    assert (room.reason, room.trouble) == ("", "")
    (tmp_path / "full").write_text("incidents\n")
    room.update()
    assert room.reason == "store is full (incidents)"
    (tmp_path / "full").write_text("")
    room.update()
    assert room.reason == "store is full"


def test_a_file_system_that_does_not_know_its_room_is_trusted(
    tmp_path: Path, free: list[int | None]
) -> None:
    free[0] = None
    assert begun(tmp_path).reason == ""
    assert (tmp_path / "reserve").exists()
