"""Ids of robots, components and experiments: short, lower case, safe in file names."""

from __future__ import annotations

import hashlib
import re
import unicodedata

_ID = re.compile(r"[a-z0-9_.-]{1,64}")
_LONGEST = 64


def is_id(text: str) -> bool:
    """Tell whether ``text`` is ``[a-z0-9_.-]{1,64}`` and no name of a folder such as ``..``."""
    return bool(_ID.fullmatch(text)) and text.strip(".") != ""


def derive_id(text: str) -> str:
    """Make an id of any name: the name itself if it is one, else a readable id close to it.

    A name that had to be cut gets 4 hex digits of its SHA-256, so that long names stay apart.
    """
    if is_id(text):
        return text
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    readable = re.sub(r"[^a-z0-9_.-]+", "_", ascii_text).strip("_.-")
    digits = hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:4]
    if not readable:
        return f"id_{digits}"
    return readable if len(readable) <= _LONGEST else f"{readable[: _LONGEST - 5]}_{digits}"
