"""Compressed pieces of hostile recordings take no more memory and disk than is allowed."""

from __future__ import annotations

import bz2
import gzip
import io
import tracemalloc
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]  # the package has no type hints
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.blackbox.formats import _recording
from amberbox.blackbox.formats._recording import (
    RecordingReport,
    unpack,
    unpack_message,
    write_unpacked,
)
from amberbox.blackbox.formats.mongodump import open_bson
from tests.fuzzing import examples, fuzz

PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "bz2": bz2.compress,
    "lz4": lz4.frame.compress,
    "zstd": zstandard.ZstdCompressor().compress,
}
SIZE = 300_000_000


@pytest.fixture(scope="module")
def bombs() -> dict[str, bytes]:
    """A few kilobytes each that unpack to 300 MB."""
    part = {name: pack(bytes(SIZE // 10)) for name, pack in PACKERS.items() if name == "bz2"}
    whole = {name: pack(bytes(SIZE)) for name, pack in PACKERS.items() if name != "bz2"}
    return part | whole


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", PACKERS)
def test_little_more_is_unpacked_than_was_promised(bombs: dict[str, bytes], name: str) -> None:
    """The announced size may be the damaged part, so 16 MB are unpacked in any case."""
    unpacked, problem = unpack(name, bombs[name], 1000)
    assert 1000 < len(unpacked) <= 16 << 20 and "instead of 1000" in problem
    assert peak_bytes(lambda: unpack(name, bombs[name], 1000)) < 100_000_000


@pytest.mark.parametrize("name", PACKERS)
def test_a_promise_of_gigabytes_is_refused(bombs: dict[str, bytes], name: str) -> None:
    unpacked, problem = unpack(name, bombs[name], 0xFFFFFFFF)
    assert len(unpacked) <= 16 << 20 and "4294967295 bytes" in problem
    assert peak_bytes(lambda: unpack(name, bombs[name], 0xFFFFFFFF)) < 100_000_000


def test_a_message_that_unpacks_to_too_much_is_kept_as_it_is(
    bombs: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_recording, "MOST_BYTES", 1_000_000)
    assert unpack_message(bombs["zstd"]) is None
    assert unpack_message(PACKERS["zstd"](b"fine")) == b"fine"
    assert unpack_message(b"not zstd") is None


def test_unpacking_a_file_leaves_room_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = iter([_recording.DISK_LEFT_BYTES + 50_000_000, _recording.DISK_LEFT_BYTES])
    monkeypatch.setattr(_recording, "_free_bytes", lambda target: next(free))
    problem = write_unpacked((bytes(1 << 20) for _ in range(999)), tmp_path / "unpacked")
    assert problem.startswith("less than 1024 MiB are left")
    assert (tmp_path / "unpacked").stat().st_size <= 50_000_000


def test_a_packed_collection_is_unpacked_little_by_little(tmp_path: Path) -> None:
    packed = tmp_path / "a.bson.gz"
    packed.write_bytes(gzip.compress(bytes(30_000_000)))
    report = RecordingReport("dump")
    with ExitStack() as stack:
        assert peak_bytes(lambda: open_bson(packed, report, stack)) < 5_000_000
        assert open_bson(packed, report, stack).size == 30_000_000
    assert report.damage == []


@fuzz
@settings(max_examples=examples(40))
@given(st.sampled_from(list(PACKERS)), st.binary(max_size=3000), st.integers(0, 4000), st.data())
def test_damaged_data_unpack_as_far_as_they_go(
    name: str, data: bytes, promised: int, draw: st.DataObject
) -> None:
    packed = bytearray(PACKERS[name](data))
    assert unpack(name, bytes(packed), len(data)) == (data, "")
    packed[draw.draw(st.integers(0, len(packed) - 1))] ^= draw.draw(st.integers(1, 255))
    unpacked, problem = unpack(name, bytes(packed), promised)
    assert len(unpacked) == promised or problem


def test_pieces_of_any_size_are_written_as_they_are(tmp_path: Path) -> None:
    content = io.BytesIO(PACKERS["zstd"](b"abc" * 100_000))
    pieces = zstandard.ZstdDecompressor().read_to_iter(content)
    assert write_unpacked(pieces, tmp_path / "a") == ""
    assert (tmp_path / "a").read_bytes() == b"abc" * 100_000
