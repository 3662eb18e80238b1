"""The end of a growing journal: its head states how far it reaches, a tail reads added chunks.

The head is a small file that the writer updates in place. It is a hint for live readers (the
written end, the durable end, the watermark); only the journal itself counts, and recovery never
reads the head.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from amberbox.blackbox.journal.chunk import Chunk, open_buffer
from amberbox.blackbox.journal.scan import JournalWalk, MetadataRecord

HEAD_NAME = "head"
_SIZE = 512


@dataclass(frozen=True, slots=True)
class JournalHead:
    """The end of a journal as its writer sees it."""

    store_id: str
    run: int
    next_seq: int
    durable_seq: int
    watermark_ns: int
    file: str
    size: int


class HeadFile:
    """Overwrites the head in place: one line of fixed size with a CRC."""

    _fd = -1

    def __init__(self, folder: Path) -> None:
        self._fd = os.open(folder / HEAD_NAME, os.O_WRONLY | os.O_CREAT, 0o644)

    def write(self, head: JournalHead) -> None:
        """Replace the head."""
        content = json.dumps(asdict(head), separators=(",", ":")).encode()
        line = b"%08x %s\n" % (zlib.crc32(content), content)
        os.pwrite(self._fd, line.ljust(_SIZE), 0)

    def close(self) -> None:
        """Close the file; the last head stays."""
        fd, self._fd = self._fd, -1
        os.close(fd)

    def __del__(self) -> None:
        if self._fd >= 0:  # its writer was dropped without an end, as after an error
            os.close(self._fd)


def is_padded(folder: Path) -> bool:
    """Return whether only padding follows the content of a journal's head."""
    content = (folder / HEAD_NAME).read_bytes()
    return content == content.rstrip(b" ").ljust(_SIZE) and content.rstrip(b" ").endswith(b"}\n")


def read_head(folder: Path) -> JournalHead | None:
    """Read a journal's head; None when there is none or it was read while being written."""
    try:
        line = (folder / HEAD_NAME).read_bytes().rstrip()
        crc, content = line.split(b" ", 1)
        if int(crc, 16) != zlib.crc32(content):
            return None
        return JournalHead(**json.loads(content))
    except (OSError, ValueError, TypeError):
        return None


class FileTail:
    """Reads on in a journal file while it grows: each valid chunk once.

    A torn end is left for the next call; ``at`` is the offset where that begins.
    """

    def __init__(self, path: Path, at: int = 0) -> None:
        self.path = path
        self.at = at
        self.first_seq = 0  # position of the first message of the file, by its start record
        self._trusted = at
        self._tag = ""

    def chunks(self) -> Iterator[Chunk]:
        """Yield the chunks that were added since the last call.

        Raises FileNotFoundError once the file is deleted.
        """
        with open_buffer(self.path) as data:
            if len(data) <= self.at:
                return
            walk = JournalWalk(data, at=self.at, tag=self._tag, grows=True, trusted=self._trusted)
            for found in walk:
                if isinstance(found, MetadataRecord):
                    self._tag = walk.tag
                    self.first_seq = int(found.values.get("first_seq", self.first_seq))
                elif isinstance(found, Chunk):
                    yield found
                self.at, self._trusted = walk.at, walk.trusted
            self.at, self._trusted = walk.at, walk.trusted
