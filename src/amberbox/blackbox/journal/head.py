"""How far a journal reaches right now: a small file that its writer updates in place.

It is a hint for those who follow live (what is written, what is durable, the watermark); the
journal itself is the truth, and recovery never reads the head.
"""

from __future__ import annotations

import json
import os
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

NAME = "head"
_SIZE = 512


@dataclass(frozen=True, slots=True)
class Head:
    """The end of a journal as its writer sees it."""

    store_id: str
    run: int
    next_seq: int
    durable_seq: int
    watermark_ns: int
    file: str
    size: int


class HeadFile:
    """Writes the head in one piece of fixed size with a CRC."""

    def __init__(self, folder: Path) -> None:
        self._fd = os.open(folder / NAME, os.O_WRONLY | os.O_CREAT, 0o644)

    def write(self, head: Head) -> None:
        """Replace the head."""
        content = json.dumps(asdict(head), separators=(",", ":")).encode()
        line = b"%08x %s\n" % (zlib.crc32(content), content)
        os.pwrite(self._fd, line.ljust(_SIZE), 0)

    def close(self) -> None:
        """Close the file; the last head stays."""
        os.close(self._fd)


def is_padded(folder: Path) -> bool:
    """Tell whether nothing but padding follows the content of a journal's head."""
    content = (folder / NAME).read_bytes()
    return content == content.rstrip(b" ").ljust(_SIZE) and content.rstrip(b" ").endswith(b"}\n")


def read_head(folder: Path) -> Head | None:
    """Read a journal's head; None when there is none or it was read while being written."""
    try:
        line = (folder / NAME).read_bytes().rstrip()
        crc, content = line.split(b" ", 1)
        if int(crc, 16) != zlib.crc32(content):
            return None
        return Head(**json.loads(content))
    except (OSError, ValueError, TypeError):
        return None
