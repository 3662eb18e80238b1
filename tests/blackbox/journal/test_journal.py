"""Journals: any MCAP reader reads finished ones, and damage affects only the damaged chunks."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader

from amberbox.blackbox.journal.chunk import open_buffer
from amberbox.blackbox.journal.scan import FileScan, read_chunk, scan
from amberbox.blackbox.journal.writer import CHUNK_BYTES, JournalOptions, JournalWriter
from amberbox.core.types import Schema, Topic

Row = tuple[int, int, bytes]
START_NS = 1_700_000_000_000_000_000
PAGE = 4096


def new_writer(folder: Path, **options: int) -> JournalWriter:
    writer = JournalWriter(
        JournalOptions(folder, "5c0fe1e2-0000", "main", 7, "b007b007-1111", **options)
    )
    for number in range(4):
        schema = Schema(f"test_msgs/T{number}", "ros1msg", b"int32 value\n" * (number + 1))
        writer.channel(Topic(f"/t{number}", "ros1", schema), {"item": f"ros_t{number}"})
    return writer


def write_rows(writer: JournalWriter, chunks: int, seed: int) -> list[Row]:
    """Write chunks of random messages, a sync now and then, and return what was written."""
    rng = random.Random(seed)
    rows: list[Row] = []
    for chunk in range(chunks):
        count = rng.randint(1, 30)
        part = [
            (rng.randrange(4), START_NS + chunk * 10**8 + k, rng.randbytes(rng.randint(0, 300)))
            for k in range(count)
        ]
        channels, times, messages = zip(*part, strict=True)
        writer.write(channels, times, times, messages)
        rows += part
        if chunk % 10 == 9:
            writer.mark_sync().wait()
    return rows


def read_rows(path: Path, *, walk: bool = False) -> tuple[FileScan, list[Row]]:
    found = scan(path, walk=walk)
    rows: list[Row] = []
    with open_buffer(path) as data:
        for place in found.places:
            chunk = read_chunk(data, place)
            assert chunk is not None
            messages = chunk.messages(np.arange(len(chunk)))
            rows += zip(chunk.channel.tolist(), chunk.log_ns.tolist(), messages, strict=True)
    return found, rows


def finished(folder: Path, chunks: int = 40, seed: int = 1) -> tuple[Path, list[Row]]:
    writer = new_writer(folder)
    rows = write_rows(writer, chunks, seed)
    path = writer.path
    assert path is not None
    writer.close()
    return path, rows


@pytest.mark.parametrize("walk", [False, True])
def test_what_was_written_is_read(tmp_path: Path, walk: bool) -> None:
    path, rows = finished(tmp_path)
    found, back = read_rows(path, walk=walk)
    assert back == rows
    assert found.finished
    assert not found.damage
    assert found.start["run"] == "7"


def test_mcap_seeking_reader_agrees(tmp_path: Path) -> None:
    path, rows = finished(tmp_path)
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(rows)
        assert summary.statistics.chunk_count == 40
        read = [(c.id, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        names = {record.name for record in reader.iter_metadata()}
    assert read == rows
    assert names == {"amberbox/start", "amberbox/chain"}


def test_an_unfinished_file_streams_to_its_last_chunk(tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    rows = write_rows(writer, 12, seed=2)
    assert writer.path is not None
    with writer.path.open("rb") as file:
        read = []
        try:
            for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                read.append((channel.id, message.log_time, message.data))
        except Exception as error:  # the reader's way to say that the end is missing
            assert "EndOfFile" in type(error).__name__ or "end" in str(error).lower()
    assert read == rows


def test_sequence_counts_without_holes_over_files(tmp_path: Path) -> None:
    writer = new_writer(tmp_path, rotate_bytes=20_000)
    total = 0
    for part in range(30):
        if writer.rotation_due(START_NS):
            writer.rotate()
        total += len(write_rows(writer, 1, seed=part))
    writer.close()
    files = sorted(tmp_path.glob("*.mcap"))
    assert len(files) > 3
    numbers: list[int] = []
    chains = []
    for path in files:
        found = scan(path)
        assert int(found.start["first_seq"]) == len(numbers)
        chains.append((found.start["chain"], found.chain))
        with open_buffer(path) as data:
            for place in found.places:
                chunk = read_chunk(data, place)
                assert chunk is not None
                numbers += chunk.sequence.tolist()
    assert numbers == list(range(total))
    assert all(a[1] == b[0] for a, b in pairwise(chains))


def test_a_large_message_has_a_chunk_of_its_own(tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    big = bytes(3 * CHUNK_BYTES)
    rows = [(0, START_NS, b"a"), (1, START_NS + 1, big), (0, START_NS + 2, b"b")]
    channels, times, messages = zip(*rows, strict=True)
    writer.write(channels, times, times, messages)
    path = writer.path
    assert path is not None
    writer.close()
    found, back = read_rows(path)
    assert back == rows
    assert [place.count for place in found.places] == [1, 1, 1]
    assert found.summary.chunks[1].compression == ""


def test_a_full_disk_leaves_the_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os

    writer = new_writer(tmp_path)
    rows = write_rows(writer, 3, seed=3)
    real_write = os.write

    def torn_write(fd: int, data: bytes) -> int:
        real_write(fd, bytes(data)[:100])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", torn_write)
        with pytest.raises(OSError, match="No space"):
            writer.write([0], [START_NS], [START_NS], [b"x" * 500])
    assert writer.next_seq == len(rows)
    rows += write_rows(writer, 3, seed=4)
    path = writer.path
    assert path is not None
    writer.close()
    assert read_rows(path, walk=True)[1] == rows


def flip(data: bytearray, rng: random.Random) -> tuple[int, int]:
    place = rng.randrange(len(data))
    data[place] ^= 1 << rng.randrange(8)
    return place, place + 1


def zero(data: bytearray, rng: random.Random) -> tuple[int, int]:
    place = rng.randrange(0, len(data), PAGE)
    end = min(place + PAGE, len(data))
    data[place:end] = bytes(end - place)
    return place, end


def swap(data: bytearray, rng: random.Random) -> tuple[int, int]:
    pages = len(data) // PAGE
    a, b = sorted((rng.randrange(pages) * PAGE, rng.randrange(pages) * PAGE))
    data[a : a + PAGE], data[b : b + PAGE] = data[b : b + PAGE], data[a : a + PAGE]
    return a, b + PAGE


def cut(data: bytearray, rng: random.Random) -> tuple[int, int]:
    place, end = rng.randrange(8, len(data)), len(data)
    del data[place:]
    return place, end


@pytest.mark.parametrize("damage", [flip, zero, cut])
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32))
@example(seed=2420)  # flips an index record into one that ends the data
def test_damage_costs_only_the_chunks_it_touches(
    tmp_path_factory: pytest.TempPathFactory,
    damage: Callable[[bytearray, random.Random], tuple[int, int]],
    seed: int,
) -> None:
    path, rows = finished(tmp_path_factory.mktemp("damage"), seed=5)
    sound = scan(path)
    data = bytearray(path.read_bytes())
    ends = [place.offset for place in sound.places[1:]] + [len(data)]
    start, end = damage(data, random.Random(seed))
    path.write_bytes(data)
    kept: list[Row] = []
    at = 0
    for place, chunk_end in zip(sound.places, ends, strict=True):
        if end <= place.offset or start >= chunk_end:
            kept += rows[at : at + place.count]
        at += place.count
    found, back = read_rows(path, walk=True)
    remaining = iter(back)
    assert all(row in remaining for row in kept), "an untouched chunk was lost"
    original = iter(rows)
    assert all(row in original for row in back), "a row was made up or came out of order"
    lost = len(rows) - len(back)
    seen = sum(place.count for place in found.places)
    assert seen == len(back)
    if lost and start < ends[-2]:
        assert found.damage or not found.finished, "rows are missing and nothing says so"


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32))
def test_swapped_pages_keep_the_order(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path, rows = finished(tmp_path_factory.mktemp("swap"), seed=6)
    data = bytearray(path.read_bytes())
    swap(data, random.Random(seed))
    path.write_bytes(data)
    original = iter(rows)
    assert all(row in original for row in read_rows(path, walk=True)[1])


def test_a_chunk_of_another_run_is_not_believed(tmp_path: Path) -> None:
    path, rows = finished(tmp_path / "a")
    other = JournalWriter(JournalOptions(tmp_path / "b", "5c0fe1e2-0000", "main", 6, "b007"))
    other.channel(Topic("/t0", "ros1", None), {"item": "ros_t0"})
    other.write([0], [START_NS], [START_NS], [b"stale"])
    stale = other.path
    assert stale is not None
    foreign = stale.read_bytes()
    first = scan(stale).places[0].offset
    data = path.read_bytes()
    place = scan(path).places[20].offset
    path.write_bytes(data[:place] + foreign[first:] + data[place:])
    found, back = read_rows(path, walk=True)
    assert back == rows
    inserted = found.damage[0]
    assert (inserted.from_offset, inserted.to_offset) == (place, place + len(foreign) - first)
