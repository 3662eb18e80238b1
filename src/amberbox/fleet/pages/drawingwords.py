"""The words of all drawings, out of the catalogue."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache

from amberbox.fleet.drawing.words import Words
from amberbox.fleet.pages.strings import catalogue

_LEVELS = ("ok", "warn", "error", "stale", "unknown")


@lru_cache
def drawing_words() -> Words:
    """Return what drawings say."""
    text = catalogue().text
    levels = {name: text(f"common.level.{name}") for name in _LEVELS}
    own = {one.name: text(f"drawing.{one.name}") for one in fields(Words) if one.name not in levels}
    return Words(**levels, **own)
