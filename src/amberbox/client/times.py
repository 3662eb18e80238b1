"""Times as the server writes them: RFC 3339 with nanoseconds, UTC."""

from __future__ import annotations

import numpy as np

from amberbox.core.timetext import format_time
from amberbox.core.types import IntArray

Time = int | str | None
"""Nanoseconds since the Unix epoch, or a text: RFC 3339, an epoch, ``now-10m``, ``-10m``."""


def time_ns(text: str) -> int:
    """Read a time that the server wrote."""
    return int(times_ns([text])[0])


def times_ns(texts: list[str]) -> IntArray:
    """Read many."""
    plain = np.array([text.removesuffix("Z") for text in texts], "datetime64[ns]")
    return plain.astype(np.int64)


def maybe_ns(text: str | None) -> int | None:
    """Read a time that may not have come."""
    return None if text is None else time_ns(text)


def said(moment: Time) -> str:
    """Write a time for a question; empty for None. Texts go as they are: the server reads them."""
    if moment is None:
        return ""
    return moment if isinstance(moment, str) else format_time(moment)
