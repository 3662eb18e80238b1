"""Options of a configuration class: a default, one line of documentation, marks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

_REQUIRED: Any = object()


def option(
    default: Any = _REQUIRED,
    doc: str = "",
    *,
    unit: str = "",
    secret: bool = False,
    aliases: Sequence[str] = (),
) -> Any:
    """Declare one key of a configuration class.

    Without ``default`` the key is required. ``secret`` values never leave the robot folder.
    ``aliases`` are other spellings that are accepted, such as the paper's.
    """
    metadata = {"doc": doc, "unit": unit, "secret": secret, "aliases": tuple(aliases)}
    if default is _REQUIRED:
        return dataclasses.field(metadata=metadata)
    if isinstance(default, dict | list):
        kind = type(default)
        return dataclasses.field(default_factory=lambda: kind(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)
