"""Columns in memory: rows taken, joined, widened, elements picked; against plain Python lists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.columns import arrays as col
from amberbox.blackbox.columns.table_text import plain
from amberbox.core.types import ColumnData, Ragged


def ragged(rows: list[list[float]]) -> Ragged:
    offsets = np.cumsum([0] + [len(row) for row in rows])
    return Ragged(offsets, np.array([value for row in rows for value in row], float))


def masked(values: list[int | None]) -> ColumnData:
    data = np.array([value or 0 for value in values], np.int64)
    return np.ma.masked_array(data, mask=[value is None for value in values])


lists = st.lists(st.lists(st.floats(allow_nan=False, width=32), max_size=4), max_size=8)
optional = st.lists(st.none() | st.integers(-(2**40), 2**40), max_size=8)


@given(lists, st.data())
def test_take_of_lists(rows: list[list[float]], data: st.DataObject) -> None:
    column = ragged(rows)
    chosen = data.draw(st.lists(st.integers(0, len(rows) - 1), max_size=5) if rows else st.just([]))
    assert plain(col.take(column, np.array(chosen, np.int64))) == [rows[row] for row in chosen]
    flags = np.array(
        data.draw(st.lists(st.booleans(), min_size=len(rows), max_size=len(rows))), bool
    )
    kept = [row for row, flag in zip(rows, flags, strict=True) if flag]
    assert plain(col.take(column, flags)) == kept
    start, stop = data.draw(st.tuples(st.integers(0, 9), st.integers(0, 9)))
    assert plain(col.take(column, slice(start, stop))) == rows[start:stop]


@given(st.lists(lists, min_size=1, max_size=4), st.data())
def test_concatenate_lists(parts: list[list[list[float]]], data: st.DataObject) -> None:
    columns = [ragged(part) for part in parts]
    cuts = [data.draw(st.integers(0, len(part))) for part in parts]
    cut = [col.take(column, slice(at, None)) for column, at in zip(columns, cuts, strict=True)]
    expected = [row for part, at in zip(parts, cuts, strict=True) for row in part[at:]]
    assert plain(col.concatenate(cut)) == expected


@given(st.lists(optional, min_size=1, max_size=4))
def test_concatenate_keeps_nulls(parts: list[list[int | None]]) -> None:
    columns: list[ColumnData] = [masked(part) for part in parts]
    columns[0] = masked(parts[0]) if None in parts[0] else np.array(parts[0], np.int64)
    joined = col.concatenate(columns)
    assert plain(joined) == [value for part in parts for value in part]


def test_lists_join_with_missing_lists() -> None:
    joined = col.concatenate([col.nulls("list<float64>", 2), ragged([[1.0], []])])
    assert plain(joined) == [None, None, [1.0], []]
    assert col.null_mask(joined).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("first", "second", "both"),
    [
        ("int64", "float64", "float64"),
        ("int32", "uint32", "int64"),
        ("float32", "int32", "float64"),
        ("int64", "string", "string"),
        ("bool", "int64", "string"),
        ("time", "time", "time"),
        ("list<int64>", "list<float64>", "list<float64>"),
        ("list<int64>", "int64", "string"),
        ("binary", "string", "string"),
    ],
)
def test_wider_type_holds_both(first: str, second: str, both: str) -> None:
    assert col.wider(first, second) == both == col.wider(second, first)


@pytest.mark.parametrize(
    ("column", "old", "new", "expected"),
    [
        (np.array([1, 2]), "int64", "float64", [1.0, 2.0]),
        (np.array([1, 2]), "int64", "string", ["1", "2"]),
        (np.array([0.5, 2.0]), "float64", "string", ["0.5", "2.0"]),
        (np.array([True]), "bool", "string", ["true"]),
        (masked([1, None]), "int64", "float64", [1.0, None]),
        (masked([1, None]), "int64", "string", ["1", None]),
        (ragged([[1.0], []]), "list<float64>", "string", ["[1.0]", "[]"]),
        (ragged([[1.0], []]), "list<float32>", "list<float64>", [[1.0], []]),
        (col.objects([b"\x01", None]), "binary", "string", ["01", None]),
        (col.objects(["a"]), "string", "string", ["a"]),
    ],
)
def test_cast_widens(column: ColumnData, old: str, new: str, expected: list[Any]) -> None:
    assert plain(col.cast(column, old, new)) == expected


@given(lists, st.integers(-4, 4))
def test_element_is_null_where_the_list_is_shorter(rows: list[list[float]], index: int) -> None:
    expected = [row[index] if -len(row) <= index < len(row) else None for row in rows]
    assert plain(col.element(ragged(rows), index)) == expected
    with_null = col.concatenate([col.nulls("list<float64>", 1), ragged(rows)])
    assert plain(col.element(with_null, index)) == [None, *expected]


def test_element_of_texts() -> None:
    column = Ragged(np.array([0, 2, 2]), col.objects(["a", "b"]))
    assert plain(col.element(column, 1)) == ["b", None]


@pytest.mark.parametrize(
    "kind", ["bool", "int8", "float64", "time", "string", "binary", "list<int8>"]
)
def test_nulls_and_empty_have_the_type_s_shape(kind: str) -> None:
    assert plain(col.nulls(kind, 2)) == [None, None]
    assert len(col.empty(kind)) == 0
    joined = col.concatenate([col.empty(kind), col.nulls(kind, 1)])
    assert plain(joined) == [None]
