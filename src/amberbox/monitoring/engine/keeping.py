"""Values as a snapshot keeps them: JSON has no NaN and no infinity."""

from __future__ import annotations

import math
from typing import Any


def as_json(value: Any) -> Any:
    """Return a value as JSON keeps it: what is no finite number stands in a list of its own."""
    return [repr(value)] if isinstance(value, float) and not math.isfinite(value) else value


def of_json(kept: Any) -> Any:
    """Return the value that ``as_json`` kept."""
    return float(kept[0]) if isinstance(kept, list) else kept
