"""Choose how a column is written to Parquet, by its type and by what it holds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.segments import columns as col
from amberbox.core.types import ColumnData, Ragged

DICTIONARY = "dictionary"
_SAMPLE_ROWS = 4096
_SAMPLE_BLOCKS = 4
_INT_DICTIONARY_SHARE = 1 / 64
_FLOAT_DICTIONARY_SHARE = 1 / 3


def choose(column: ColumnData, column_type: str) -> str:
    """Return ``dictionary`` or the name of a Parquet encoding.

    Dictionary: strings, constants, few-valued ints, floats that are quantised (a decimal sensor
    reading repeats its values). BYTE_STREAM_SPLIT: other floats. DELTA_BINARY_PACKED: other ints.
    """
    values = column.values if isinstance(column, Ragged) else column
    kind = col.element_type(column_type) or column_type
    if values.dtype == object or kind in ("string", "binary"):
        return _for_objects(values)
    if kind == "bool":
        return "PLAIN"
    share = _distinct_share(np.ma.getdata(values))
    if kind in ("float32", "float64"):
        return DICTIONARY if share <= _FLOAT_DICTIONARY_SHARE else "BYTE_STREAM_SPLIT"
    return DICTIONARY if share <= _INT_DICTIONARY_SHARE else "DELTA_BINARY_PACKED"


def _for_objects(values: NDArray[Any]) -> str:
    """Large binaries (images, maps) hardly repeat: a dictionary of them is wasted work."""
    head = values[: _SAMPLE_ROWS // 16]
    large = any(isinstance(value, bytes) and len(value) > 256 for value in head)
    return "PLAIN" if large else DICTIONARY


def _distinct_share(values: NDArray[Any]) -> float:
    """Estimate which share of the values is new, from blocks spread over the column."""
    count = len(values)
    if count == 0:
        return 0.0
    sample = _sample(values)
    bits = sample.view(f"u{sample.dtype.itemsize}")
    return len(np.unique(bits)) / len(bits)


def _sample(values: NDArray[Any]) -> NDArray[Any]:
    if len(values) <= _SAMPLE_ROWS:
        return np.ascontiguousarray(values)
    block = _SAMPLE_ROWS // _SAMPLE_BLOCKS
    starts = np.linspace(0, len(values) - block, _SAMPLE_BLOCKS).astype(int)
    return np.concatenate([values[start : start + block] for start in starts])
