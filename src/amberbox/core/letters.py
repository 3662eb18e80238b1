"""Words of other scripts in Latin letters, so that names made of them can still be read."""
# ruff: noqa: RUF001  # letters that look like Latin ones are what this is about

from __future__ import annotations

import unicodedata

_TABLES = (
    "а a б b в v г g д d е e ё yo ж zh з z и i й y к k л l м m н n о o п p р r с s т t у u ф f х "
    "kh ц ts ч ch ш sh щ shch ы y э e ю yu я ya є ye і i ї yi ґ g ў u ј j љ lj њ nj ћ c ђ dj џ dz",
    "α a β b γ g δ d ε e ζ z η i θ th ι i κ k λ l μ m ν n ξ x ο o π p ρ r σ s ς s τ t υ y φ f χ ch "
    "ψ ps ω o",
    "ß ss æ ae œ oe ø o đ d ð d þ th ł l \u0131 i",
)
"""How letters of Cyrillic, of Greek, and Latin ones that are no letter with a mark are written."""

_HANGUL = frozenset(map(chr, range(0xAC00, 0xD7A4)))
_WORDS = " ".join(_TABLES).split()
_KNOWN = {**dict(zip(_WORDS[::2], _WORDS[1::2], strict=True)), "ъ": "", "ь": ""}


def latin(text: str) -> str:
    """Write every letter and digit in ASCII: é as e, ж as zh, ب as beh, 温 as u6e29.

    Letters of alphabets without a table here are spelled by their Unicode names, ideographs by
    their numbers. What is no letter or digit stays.
    """
    if text.isascii():
        return text
    return "".join(map(_latin, unicodedata.normalize("NFC", text)))


def _latin(letter: str) -> str:
    known = _KNOWN.get(letter.lower())
    if known is not None:
        return known.capitalize() if letter.isupper() else known
    if letter in _HANGUL:
        return unicodedata.name(letter).rpartition(" ")[2].lower()
    return "".join(map(_plain, unicodedata.normalize("NFKD", letter)))


def _plain(letter: str) -> str:
    if letter.isascii() or not (letter.isalnum() or unicodedata.combining(letter)):
        return letter
    if unicodedata.combining(letter):
        return ""
    if letter.isdecimal():
        return str(unicodedata.decimal(letter))
    known = _KNOWN.get(letter.lower())
    if known is not None:
        return known.capitalize() if letter.isupper() else known
    name = unicodedata.name(letter, "").rpartition(" ")[2]
    return f"{name.lower()}_" if name.isalpha() and len(name) > 2 else _short(name, letter)


def _short(name: str, letter: str) -> str:
    return name.lower() if name.isalpha() else f"u{ord(letter):x}"
