"""What a person may say about a recording that the recording itself leaves open."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read recordings that do not tell everything about themselves.

    ``messages`` is a folder of ``.msg`` files, ``time`` the name of the time column of a table,
    ``start_ns`` when a recording begins whose times do not say.
    """

    messages: Path | None = None
    time: str | None = None
    start_ns: int | None = None
