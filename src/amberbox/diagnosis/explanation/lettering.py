"""How wide text is at most in any common sans-serif font, and how it is broken into lines."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from html import escape

SIZE = 13
SMALL = 11

NARROW = frozenset("iIjl.,:;'|!")
SLIM = frozenset('frt()[]{}-/\\" ')
BROAD = frozenset("mwMW%@&#")
"""Characters by their width: 0.39, 0.47, 0.7 and 1.05 of the font's size, bold included."""

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_BREAKS = re.compile(r"(?<=[/_#.+\-])")


def escaped(text: str) -> str:
    """Write text so that it is only text; what XML does not allow becomes a question mark."""
    return escape(_FORBIDDEN.sub("\ufffd", text))


def width(text: str, size: float = SIZE) -> float:
    """Return an upper estimate of the width of a line, in pixels."""
    return size * sum(map(_share, text))


def _share(character: str) -> float:
    if unicodedata.combining(character):
        return 0.0
    if unicodedata.east_asian_width(character) in "WF" or ord(character) > 0xFFFF:
        return 1.15
    if character in BROAD:
        return 1.05
    if character in NARROW:
        return 0.39
    if character in SLIM:
        return 0.47
    if ord(character) > 0x2FF:
        return 1.0
    return 0.85 if character.isupper() else 0.7


def wrapped(text: str, most: float, size: float = SIZE) -> list[str]:
    """Break text into lines no wider than ``most`` pixels, within a word if it must be."""
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
