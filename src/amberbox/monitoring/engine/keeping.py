"""Values as JSON keeps them, which has no NaN, no infinity and no half characters."""

from __future__ import annotations

import math
from typing import Any


def as_json(value: Any) -> Any:
    """Return a value as JSON keeps it: what is no finite number stands in a list of its own."""
    return [repr(value)] if isinstance(value, float) and not math.isfinite(value) else value


def of_json(kept: Any) -> Any:
    """Return the value that ``as_json`` kept."""
    return float(kept[0]) if isinstance(kept, list) else kept


def readable(text: str) -> str:
    """Return a text with question marks for what is no character."""
    return text if text.isascii() else text.encode("utf-8", "replace").decode()
