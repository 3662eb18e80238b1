"""The types of a dataclass' fields, worked out once: every entry of every file asks for them."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any

_known: dict[type[Any], Mapping[str, Any]] = {}


def field_types(cls: type[Any]) -> Mapping[str, Any]:
    """Return the types of a dataclass' fields by name."""
    found = _known.get(cls)
    if found is None:
        found = _known[cls] = typing.get_type_hints(cls)
    return found
