"""Secrets that the server makes: 256 random bits each, of which it keeps only a hash.

A plain SHA-256 is right for these: nobody can try out 2**256 values, so a slow hash would add
nothing but the time that every request and every robot's connection costs. Passwords, which people
choose, are hashed in ``passwords``.
"""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass

from amberbox.link.keys import MARKS, Kind


@dataclass(frozen=True, slots=True)
class Secret:
    """A new secret: its whole text, to be shown once, its public id, and the hash to keep.

    The text is ``abt_<id>_<43 characters>``: the mark says what it is for, so that tools that look
    for leaked secrets find it.
    """

    text: str
    id: str
    hash: str

    def __repr__(self) -> str:
        return f"Secret({self.id})"


def new_secret(kind: Kind) -> Secret:
    """Make a secret of the system's random numbers."""
    id_ = secrets.token_hex(6)
    text = f"{MARKS[kind]}_{id_}_{secrets.token_urlsafe(32)}"
    return Secret(text, id_, digest(text))


def digest(text: str) -> str:
    """Return the SHA-256 of a secret, 64 hex digits."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
