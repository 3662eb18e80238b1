"""Segments as files: every value is read bit for bit, by range, with checked pages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.flat_tables import FlatTable, TableSchema, join_tables
from amberbox.blackbox.store.manifest_entries import Segment, SegmentPart
from amberbox.blackbox.store.segment_file import (
    SegmentWriter,
    choose_encoding,
    describe,
    read_segment,
)
from amberbox.core.types import Column, ColumnData, Ragged

T0 = 1_790_000_000_000_000_000
NUMBERS = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]


def table(columns: dict[str, tuple[str, ColumnData]], count: int, start: int = 0) -> FlatTable:
    fields = tuple(Column(name, name, kind) for name, (kind, _) in columns.items())
    schema = TableSchema("item", "test/Type", fields, stamp="stamp")
    seq = np.arange(start, start + count)
    times = T0 + seq * 10_000_000
    values = {name: column for name, (_, column) in columns.items()}
    return FlatTable(schema, "main", 3, seq, times, times, times - 5, values)


def write(
    store: Path, flats: Sequence[FlatTable], path: str = "segments/item/a.parquet"
) -> Segment:
    file = SegmentWriter(store, path, flats[0].schema)
    for flat in flats:
        file.write(flat)
    whole = join_tables(flats)
    seq, log, stamp = whole.seq, whole.log_time_ns, whole.timestamp_ns
    return file.finish([
        SegmentPart("journal/a.mcap", "h", "main", 3, int(seq.min()), int(seq.max()), len(whole),
             int(log.min()), int(log.max()), int(stamp.min()), int(stamp.max()))
    ])  # fmt: skip


def bits(column: ColumnData) -> Any:
    """Return what makes two columns equal: dtype, bits, nulls, lists."""
    if isinstance(column, Ragged):
        lists = col.compact(column)
        return "lists", lists.offsets.tolist(), bits(lists.values)
    if column.dtype == object:
        return [bits(v) if isinstance(v, np.ndarray) else v for v in column]
    mask = col.null_mask(column)
    plain = np.where(mask, np.zeros(1, column.dtype), np.ma.getdata(column))
    return column.dtype.str, mask.tolist(), plain.tobytes()


def numbers(kind: str, count: int) -> st.SearchStrategy[Any]:
    limits = np.iinfo(kind)
    return st.lists(st.integers(int(limits.min), int(limits.max)), min_size=count, max_size=count)


@st.composite
def columns(draw: st.DrawFn, count: int) -> dict[str, tuple[str, ColumnData]]:
    made: dict[str, tuple[str, ColumnData]] = {}
    for kind in NUMBERS:
        made[kind] = kind, np.array(draw(numbers(kind, count)), kind)
    words = st.lists(st.integers(0, 2**64 - 1), min_size=count, max_size=count)
    made["float64"] = "float64", np.array(draw(words), np.uint64).view(np.float64)
    short = st.lists(st.integers(0, 2**32 - 1), min_size=count, max_size=count)
    made["float32"] = "float32", np.array(draw(short), np.uint32).view(np.float32)
    flags = st.lists(st.booleans(), min_size=count, max_size=count)
    made["bool"] = "bool", np.array(draw(flags), bool)
    for name in ("float64", "int64", "uint64", "bool"):
        kind, column = made[name]
        made[f"{name}_null"] = kind, np.ma.masked_array(column, mask=np.array(draw(flags), bool))
    texts = st.lists(st.none() | st.text(max_size=5), min_size=count, max_size=count)
    made["text"] = "string", col.objects(draw(texts))
    blobs = st.lists(st.none() | st.binary(max_size=5), min_size=count, max_size=count)
    made["blob"] = "binary", col.objects(draw(blobs))
    made["moment"] = "time", np.array(draw(numbers("int64", count)), np.int64)
    made["span"] = "duration", np.array(draw(numbers("int64", count)), np.int64)
    lengths = draw(st.lists(st.integers(0, 3), min_size=count, max_size=count))
    offsets = np.cumsum([0, *lengths])
    total = int(offsets[-1])
    made["list"] = "list<float64>", Ragged(offsets, np.linspace(-1, 1, total))
    made["texts"] = "list<string>", Ragged(offsets, col.objects([str(n) for n in range(total)]))
    made["list_null"] = "list<int16>", col.concatenate([
        col.nulls("list<int16>", 1),
        col.take(Ragged(offsets, np.arange(total, dtype=np.int16)), slice(1, None)),
    ])  # fmt: skip
    return made


@settings(max_examples=40, suppress_health_check=list(HealthCheck))
@given(st.data(), st.integers(1, 12))
def test_every_value_comes_back(tmp_path: Path, data: st.DataObject, count: int) -> None:
    flat = table(data.draw(columns(count)), count)
    segment = write(tmp_path, [flat])
    (back,) = read_segment(tmp_path, segment, flat.schema, flat.columns.keys())
    assert {n: bits(c) for n, c in back.columns.items()} == {
        n: bits(c) for n, c in flat.columns.items()
    }
    for name in ("seq", "log_time_ns", "received_ns", "timestamp_ns"):
        assert getattr(back, name).tolist() == getattr(flat, name).tolist()
    assert (back.writer, back.run) == ("main", 3)


def test_special_floats_keep_their_bits_in_every_encoding(tmp_path: Path) -> None:
    special = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324], np.float64)
    payload = np.array([0x7FF8000000000ABC, 0xFFF8000000000001], np.uint64).view(np.float64)
    few = np.tile(np.concatenate((special, payload)), 1000)
    many = np.concatenate((few, np.random.default_rng(1).normal(size=16000)))
    few = np.resize(few, len(many))
    assert (choose_encoding(few, "float64"), choose_encoding(many, "float64")) == (
        "dictionary",
        "BYTE_STREAM_SPLIT",
    )
    flat = table({"few": ("float64", few), "many": ("float64", many)}, len(many))
    (back,) = read_segment(tmp_path, write(tmp_path, [flat]), flat.schema, {"few", "many"})
    assert bits(back.columns["few"]) == bits(few)
    assert bits(back.columns["many"]) == bits(many)


@pytest.mark.parametrize(
    ("column", "kind", "expected"),
    [
        (np.full(5000, 0.5), "float64", "dictionary"),
        (np.random.default_rng(1).normal(size=9000).round(1), "float64", "dictionary"),
        (np.random.default_rng(1).normal(size=9000), "float32", "BYTE_STREAM_SPLIT"),
        (np.arange(9000), "int64", "DELTA_BINARY_PACKED"),
        (np.arange(9000) // 4000, "int32", "dictionary"),
        (np.zeros(10, bool), "bool", "PLAIN"),
        (col.objects(["a"] * 10), "string", "dictionary"),
        (col.objects([bytes(1000)] * 10), "binary", "PLAIN"),
        (Ragged(np.arange(0, 9001, 3), np.random.default_rng(1).normal(size=9000)), "list<float64>",
         "BYTE_STREAM_SPLIT"),
        (np.empty(0), "float64", "dictionary"),
    ],
)  # fmt: skip
def test_encoding_follows_content(column: ColumnData, kind: str, expected: str) -> None:
    assert choose_encoding(column, kind) == expected


def test_only_row_groups_of_the_range_and_named_columns_are_read(tmp_path: Path) -> None:
    flats = [
        table({"a": ("int64", np.arange(100) + n), "b": ("int64", np.arange(100))}, 100, n)
        for n in (0, 100, 200)
    ]
    segment = write(tmp_path, flats)
    span = (T0 + 110 * 10_000_000, T0 + 120 * 10_000_000)
    (part,) = read_segment(tmp_path, segment, flats[0].schema, {"a"}, span)
    assert part.seq.tolist() == list(range(100, 200))
    assert set(part.columns) == {"a"}
    by_stamp = (T0 + 100 * 10_000_000 - 5, T0 + 100 * 10_000_000 - 4)
    (part,) = read_segment(tmp_path, segment, flats[0].schema, {"a"}, by_stamp, "timestamp")
    assert part.seq.tolist() == list(range(100, 200))
    assert read_segment(tmp_path, segment, flats[0].schema, {"a"}, (0, 5)) == []


def test_a_file_describes_itself(tmp_path: Path) -> None:
    flat = table({"a": ("uint8", np.arange(10, dtype=np.uint8))}, 10)
    segment = write(tmp_path, [flat])
    assert describe(tmp_path, segment.path) == (flat.schema, segment)
    arrow = pq.read_schema(tmp_path / segment.path)
    assert [(f.name, str(f.type)) for f in arrow] == [
        ("seq", "int64"),
        ("log_time", "int64"),
        ("timestamp", "timestamp[ns, tz=UTC]"),
        ("a", "uint8"),
    ]


def test_a_variable_called_like_ours_is_kept_apart(tmp_path: Path) -> None:
    flat = table({"log_time": ("int64", np.arange(10) * 7)}, 10)
    (back,) = read_segment(tmp_path, write(tmp_path, [flat]), flat.schema, {"log_time"})
    assert back.columns["log_time"].tolist() == flat.columns["log_time"].tolist()  # type: ignore[union-attr]  # a plain array
    assert back.log_time_ns.tolist() == flat.log_time_ns.tolist()


def test_a_flipped_bit_is_never_read_as_a_value(tmp_path: Path) -> None:
    column = np.random.default_rng(1).normal(size=5000)
    flat = table({"a": ("float64", column)}, 5000)
    segment = write(tmp_path, [flat])
    path = tmp_path / segment.path
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)
    with pytest.raises((OSError, ValueError)):
        read_segment(tmp_path, segment, flat.schema, {"a"})


def test_an_unfinished_file_leaves_nothing(tmp_path: Path) -> None:
    flat = table({"a": ("int64", np.arange(10))}, 10)
    file = SegmentWriter(tmp_path, "segments/item/b.parquet", flat.schema)
    file.write(flat)
    file.discard()
    assert list((tmp_path / "segments/item").iterdir()) == []


@pytest.mark.parametrize("by", ["received", "timestamp"])
def test_a_flipped_bit_in_the_statistics_loses_no_row(tmp_path: Path, by: str) -> None:
    """The footer has no checksum, and contains the bounds of a row group."""
    flats = [table({"v": ("int64", np.arange(50))}, 50, start) for start in (0, 50, 100)]
    segment = write(tmp_path, flats)
    path = tmp_path / segment.path
    sound, schema = path.read_bytes(), flats[0].schema
    footer = len(sound) - 8 - int.from_bytes(sound[-8:-4], "little")
    times = flats[1].log_time_ns if by == "received" else flats[1].timestamp_ns
    span = int(times[10]), int(times[40])
    bounds = [int(value).to_bytes(8, "little") for value in (times.min(), times.max())]
    places = [at for bound in bounds for at in _places(sound, bound, footer)]
    assert places, "the statistics are there"
    for at in places:
        for byte in range(8):
            damaged = bytearray(sound)
            damaged[at + byte] ^= 0x40
            path.write_bytes(damaged)
            found = read_segment(tmp_path, segment, schema, ["v"], span, by)
            assert set(range(60, 90)) <= {int(n) for flat in found for n in flat.seq}, at


def _places(content: bytes, wanted: bytes, start: int) -> list[int]:
    found = []
    while (start := content.find(wanted, start)) >= 0:
        found.append(start)
        start += 1
    return found
