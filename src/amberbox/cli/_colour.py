"""Colours of levels in a terminal; the words stand there in any case."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import IO

from amberbox.core.terminal import OWN
from amberbox.core.types import Level

Paint = Callable[[str, Level], str]

_CODES: Mapping[Level, str] = {
    **{"ok": "32", "warn": "33", "error": "1;31"},
    **{"stale": "35", "unknown": "35"},
}


def painter(file: IO[str]) -> Paint:
    """Return what colours a text by a level; nothing without a terminal or with ``NO_COLOR``."""
    return _paint if file.isatty() and not os.environ.get("NO_COLOR") else plain


def plain(text: str, level: Level) -> str:
    """Leave a text as it is."""
    return text


def _paint(text: str, level: Level) -> str:
    return f"{OWN}[{_CODES[level]}m{text}{OWN}[0m"
