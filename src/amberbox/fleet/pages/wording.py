"""How ids and texts of others are written where people read them."""

from __future__ import annotations

import re


def readable(name: str) -> str:
    """Write an id with spaces: ``laser_front`` is "laser front"."""
    return re.sub(r"[_\s]+", " ", name).strip()


def capital(text: str) -> str:
    """Begin a text with a capital; the rest stays as it is."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """Write a text as a sentence, with a capital and a full stop."""
    return capital(text) + ("" if not text or text[-1] in ".!?" else ".")
