"""Convert columns between NumPy arrays and Arrow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns import arrays as col
from amberbox.core.types import ColumnData, Ragged

if TYPE_CHECKING:
    import pyarrow as pa

_LARGEST_OFFSET = 2**31 - 1


def arrow_type(column_type: str) -> pa.DataType:
    """Return the Arrow type of a column; times are UTC, durations stay integer nanoseconds."""
    import pyarrow as pa

    inner = col.element_type(column_type)
    if inner is not None:
        return pa.list_(arrow_type(inner))
    special = {
        "time": pa.timestamp("ns", tz="UTC"),
        "duration": pa.int64(),
        "bool": pa.bool_(),
        "string": pa.string(),
        "binary": pa.binary(),
    }
    return special.get(column_type) or pa.from_numpy_dtype(col.numpy_type(column_type))


def to_arrow(column: ColumnData, column_type: str) -> pa.Array:
    """Convert a column to an Arrow array of the type that ``arrow_type`` returns."""
    import pyarrow as pa

    if isinstance(column, Ragged):
        return _list_array(column, column_type)
    kind = arrow_type(column_type)
    if column.dtype == object:
        return pa.array(column.tolist(), type=kind)
    null = np.ma.getmaskarray(column) if isinstance(column, np.ma.MaskedArray) else None
    array = _of_numbers(np.ascontiguousarray(np.ma.getdata(column)), null)
    if array.type == kind:
        return array
    return array.view(kind) if pa.types.is_timestamp(kind) else array.cast(kind)


def _of_numbers(numbers: NDArray[Any], null: NDArray[np.bool_] | None) -> pa.Array:
    """Convert numbers to an Arrow array without copying; ``pa.array`` would import pandas."""
    import pyarrow as pa

    if numbers.dtype.kind not in "iuf" or not numbers.dtype.isnative:
        return pa.array(numbers, mask=null)
    known = None if null is None else pa.py_buffer(np.packbits(~null, bitorder="little"))
    kind = pa.from_numpy_dtype(numbers.dtype)
    return pa.Array.from_buffers(kind, len(numbers), [known, pa.py_buffer(numbers)])


def _list_array(column: Ragged, column_type: str) -> pa.Array:
    import pyarrow as pa

    lists = col.compact(column)
    inner = col.element_type(column_type)
    values = to_arrow(lists.values, inner or "binary")
    if len(lists.values) > _LARGEST_OFFSET:
        return pa.LargeListArray.from_arrays(_of_numbers(lists.offsets, None), values)
    return pa.ListArray.from_arrays(_of_numbers(lists.offsets.astype(np.int32), None), values)


def from_arrow(array: pa.ChunkedArray | pa.Array, column_type: str) -> ColumnData:
    """Convert an Arrow array back to the column it was made from."""
    import pyarrow as pa

    chunks = array.chunks if isinstance(array, pa.ChunkedArray) else [array]
    if not chunks:
        return col.empty(column_type)
    return col.concatenate([_from_chunk(chunk, column_type) for chunk in chunks])


def _from_chunk(array: pa.Array, column_type: str) -> ColumnData:
    import pyarrow as pa

    inner = col.element_type(column_type)
    if inner is not None:
        return _from_list(array, inner)
    if column_type not in col.NUMPY_TYPES:
        return np.asarray(array.to_numpy(zero_copy_only=False), object)
    if pa.types.is_timestamp(array.type):
        array = array.view(pa.int64())
    kind = col.numpy_type(column_type)  # an archive holds unsigned numbers as signed ones
    if array.null_count == 0:
        return _numbers(array).astype(kind, copy=False)
    filled = array.fill_null(False if column_type == "bool" else 0)
    values = _numbers(filled).astype(kind, copy=False)
    return np.ma.masked_array(values, mask=~_numbers(array.is_valid()))


def _numbers(array: pa.Array) -> NDArray[Any]:
    """View an Arrow array as NumPy numbers; ``to_numpy`` would import pandas."""
    import pyarrow as pa

    kind, data = array.type, array.buffers()[1]
    rows = slice(array.offset, array.offset + len(array))
    if data is None:
        return np.asarray(array.to_numpy(zero_copy_only=False))
    if pa.types.is_boolean(kind):
        bits = np.unpackbits(np.frombuffer(data, np.uint8), count=rows.stop, bitorder="little")
        return bits[rows].astype(bool)
    letter = "f" if pa.types.is_floating(kind) else "iu"[pa.types.is_unsigned_integer(kind)]
    return np.frombuffer(data, f"<{letter}{kind.bit_width // 8}", rows.stop)[rows]


def _from_list(array: pa.Array, inner: str) -> ColumnData:
    values = _from_chunk(array.values, inner)
    assert not isinstance(values, Ragged)
    lists = Ragged(_numbers(array.offsets).astype(np.int64), values)
    if array.null_count == 0:
        return lists
    rows = col.lists_as_objects(lists)
    rows[~_numbers(array.is_valid())] = None
    return rows
