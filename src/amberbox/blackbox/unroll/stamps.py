"""The own time stamps of many messages, from decoded values and from columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amberbox.core.stamps import stamp_of
from amberbox.core.types import ColumnData, IntArray, Ragged


def stamps_of(values: Sequence[Any]) -> IntArray:
    """Read the stamps of many decoded values."""
    return np.array([stamp_of(value) for value in values], np.int64)


def stamps_of_column(column: ColumnData, kind: str) -> IntArray:
    """Read the stamps in a column of times, numbers or text."""
    if isinstance(column, Ragged):
        raise TypeError("a list holds no stamp")
    if kind == "time":
        return column
    return stamps_of(column.tolist())
