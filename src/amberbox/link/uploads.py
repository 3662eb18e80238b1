"""What robot and server say about journals: their names, their proofs, and how pieces are sent.

``HEAD`` tells how much is held, ``PATCH`` adds a piece at an offset, ``POST`` ends with the proof.
"""

from __future__ import annotations

import re
from typing import Literal

from msgspec import Struct

from amberbox.blackbox.store import FOLDERS
from amberbox.link.limits import PATH

State = Literal["incoming", "verified", "aside", "quarantined"]
OFFSET = "Upload-Offset"
BYTES = "Upload-Bytes"
SHA256 = "Upload-Sha256"
STATE = "Upload-State"
CRC = "Piece-Crc32"

JOURNAL_BYTES = 4 << 30
"""Most that a journal may have."""
PROOF_BYTES = 16 << 20

_FOLDERS = "|".join(FOLDERS.values())
_NAME = re.compile(rf"({_FOLDERS})/[0-9]{{1,12}}-[0-9a-z]{{1,16}}-[0-9]{{1,12}}\.mcap")
_STORE = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


class Proof(Struct, frozen=True):
    """What the robot's manifest says of a journal: its lines from the seal to a signature.

    Without a seal (journals of the ring, which only an incident keeps) there are no lines.
    ``gone`` are the lines of all that was deleted before a server had it, wherever they stand: what
    was deleted while the robot was away is behind seals of journals that never come.
    """

    lines: str = ""
    gone: str = ""


class Verdict(Struct, frozen=True):
    """What became of a journal; ``reason`` says why it was not taken."""

    state: State
    reason: str = ""


def is_journal_name(text: str) -> bool:
    """Tell whether this is ``folder/file`` of a store's journal, and nothing else."""
    return _NAME.fullmatch(text) is not None


def is_store_id(text: str) -> bool:
    """Tell whether this is a store's id."""
    return _STORE.fullmatch(text) is not None


def is_digest(text: str) -> bool:
    """Tell whether this is a SHA-256 as hex digits."""
    return _DIGEST.fullmatch(text) is not None


def address(store_id: str, journal: str) -> str:
    """Return the path of a journal on the server."""
    return f"{PATH}/journals/{store_id}/{journal}"
