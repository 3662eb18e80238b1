"""How wide text is at most in any common sans-serif font, and how it is broken into lines."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from html import escape

from amberbox.core.showing import visible

SIZE = 13
SMALL = 11

BOLDER = 1.13
"""How much wider bold text is."""

SHARES: tuple[tuple[str, float], ...] = (
    ("iIjl.,:;'|!", 0.41),
    ('frt()[]-/\\" ', 0.47),
    ("+<=>^~", 0.84),
    ("mwMW%@&#", 1.0),
)
"""How wide characters are in the widest of the common fonts, in parts of the font's size."""

OF_CHARACTER = {character: share for characters, share in SHARES for character in characters}

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_BREAKS = re.compile(r"(?<=[/_#.+\-])")


def escaped(text: str) -> str:
    """Write text so that it is only text; what XML does not allow becomes a question mark.

    What a text hides is written out.
    """
    return escape(visible(_FORBIDDEN.sub("\ufffd", text)))


def width(text: str, size: float = SIZE, *, bold: bool = False) -> float:
    """Return an upper estimate of the width of a line, in pixels."""
    return size * sum(map(_share, text)) * (BOLDER if bold else 1.0)


def _share(character: str) -> float:
    known = OF_CHARACTER.get(character)
    if known is not None:
        return known
    if unicodedata.combining(character):
        return 0.0
    if ord(character) > 0x2FF:
        return 1.15
    return 0.8 if character.isupper() else 0.66


def wrapped(text: str, most: float, size: float = SIZE, *, bold: bool = False) -> list[str]:
    """Break text into lines no wider than ``most`` pixels, within a word if it must be."""
    most = most / BOLDER if bold else most
    lines = [""]
    for piece in _pieces(text, most, size):
        together = f"{lines[-1]}{piece}"
        if width(together.rstrip(), size) <= most:
            lines[-1] = together
        else:
            lines.append(piece.lstrip())
    return [line.rstrip() for line in lines if line.strip()] or [""]


def _pieces(text: str, most: float, size: float) -> Iterator[str]:
    """Yield words with the blank before them; words too wide for a line in parts."""
    plain = re.sub(r"(?<=\d) %", "\u00a0%", " ".join(text.split()))
    for word in re.findall(" *[^ ]+", plain):
        if width(word.strip(), size) <= most:
            yield word
            continue
        for part in _BREAKS.split(word):
            yield from _cut(part, most, size)


def _cut(part: str, most: float, size: float) -> Iterator[str]:
    start = 0
    for end in range(1, len(part) + 1):
        if width(part[start : end + 1], size) > most or end == len(part):
            yield part[start:end]
            start = end
