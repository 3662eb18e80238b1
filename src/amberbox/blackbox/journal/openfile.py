"""The journal file that is being written: how far it reaches, what its end will say."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.journal.summary import Summary


@dataclass(slots=True)
class OpenFile:
    """A file and what its writer knows of it.

    ``block`` is the SHA-256 of the bytes since ``block_start``, where the last link of the chain
    ended; ``schemas_at_ns`` says from when on each schema is to be repeated.
    """

    fd: int
    path: Path
    number: int
    opened_ns: int
    size: int = 0
    summary: Summary = field(default_factory=Summary)
    schemas_at_ns: dict[int, int] = field(default_factory=dict)
    block: hashlib._Hash = field(default_factory=hashlib.sha256)
    block_start: int = 0
