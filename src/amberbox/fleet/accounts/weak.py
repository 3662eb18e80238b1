"""Which passwords are refused: short ones, and those that anybody would try first."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

SHORTEST = 12
LONGEST = 256
_FEWEST_DIFFERENT = 6
_FEWEST_LEFT = 4
_FEWEST_GUESSES = 1e8
"""So many attempts a password has to stand: zxcvbn calls that safely unguessable."""
_LOOKED_AT = 32
_MOST_SIGNS = 12
"""Beyond so many characters, and so many different digits and signs, zxcvbn takes seconds."""
_COMMON = (
    "|password|passwort|kennwort|contrasena|motdepasse|qwertyuiop|qwertzuiop|asdfghjkl|yxcvbnm"
    "|zxcvbnm|azertyuiop|qwerty|qwertz|azerty|letmein|welcome|willkommen|iloveyou|administrator|admin"
    "|root|user|test|monkey|dragon|football|baseball|sunshine|princess|superman|batman|trustno|changeme"
    "|default|guest|master|secret|geheim|login|hospital|krankenhaus|klinik|robot|roboter|ropod|amberbox"
    "|server|schalke|sommer|winter|summer|spring|fruehling|herbst|autumn|hallo|hello"
)
_LEET = str.maketrans("013457@$!", "oleastasi")
_ROWS = (
    "abcdefghijklmnopqrstuvwxyz",
    "01234567890",
    "qwertyuiop",
    "qwertzuiop",
    "asdfghjkl",
    "1q2w3e4r5t6y7u8i9o0p",
)
_YEAR = r"(?:19|20)\d\d"


def normal(password: str) -> str:
    """Return the form that is hashed: the same letters typed on another system stay the same."""
    return unicodedata.normalize("NFKC", password)


def weakness(password: str, name: str = "") -> str | None:
    """Say why a password is refused; None when it is good enough.

    A good one has 12 to 256 characters, 6 different ones, and at least 4 characters are left when
    common words, the name of the account, sequences (``1234``, ``qwer``) and repetitions are taken
    out; and it stands 100 million guesses of somebody who tries leaked passwords, names, words
    and dates first, as zxcvbn estimates it.
    """
    text = normal(password)
    if len(text) < SHORTEST:
        return f"it has {len(text)} characters, {SHORTEST} are the least"
    if len(text) > LONGEST:
        return f"it has more than {LONGEST} characters"
    if len(set(text.casefold())) < _FEWEST_DIFFERENT:
        return "it uses too few different characters"
    for plain in (text.casefold(), _plain(text.casefold())):
        if len(_left(plain, name.casefold())) < _FEWEST_LEFT:
            return "it is made of words and sequences that are tried first"
    if _is_guessed(text, name):
        return "it is like passwords that are tried first"
    return None


def _is_guessed(text: str, name: str) -> bool:
    """Tell whether both the beginning and the end are found with few guesses."""
    from zxcvbn import zxcvbn  # it reads lists of words when it is imported

    known = [*_COMMON.split("|")[1:], *_parts(name.casefold())]
    for piece in {text[:_LOOKED_AT], text[-_LOOKED_AT:]}:
        if len({char for char in piece if not char.isalpha()}) > _MOST_SIGNS:
            return False
        if zxcvbn(piece, known)["guesses"] >= _FEWEST_GUESSES:
            return False
    return True


def _left(text: str, name: str) -> str:
    """Take out what makes a password long, but not harder to guess."""
    words = sorted((*_COMMON.split("|")[1:], *_parts(name)), key=len, reverse=True)
    for word in words:
        text = text.replace(word, " ")
    for piece in _runs(text):
        text = text.replace(piece, " ")
    text = re.sub(r"(.{1,4}?)\1+", r"\1", text)
    return re.sub(rf"[\W_]|{_YEAR}", "", text)


def _plain(text: str) -> str:
    """Read digits and signs as the letters they often stand for, but for years and at the end."""
    return re.sub(rf"{_YEAR}|[\d\W]+$", "", text).translate(_LEET)


def _parts(name: str) -> Iterator[str]:
    if len(name) >= 3:
        yield name
    yield from (part for part in re.split(r"[^a-z0-9]+", name) if len(part) >= 3)


def _runs(text: str) -> Iterator[str]:
    """Yield runs of four or more that follow on a row of the keyboard or the alphabet."""
    for row in (*_ROWS, *(row[::-1] for row in _ROWS)):
        for start in range(len(text)):
            end = start
            while end < len(text) and text[start : end + 1] in row:
                end += 1
            if end - start >= 4:
                yield text[start:end]
