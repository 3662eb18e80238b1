"""Lines of the manifest: JSON objects, each of which states the hash of the one before."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amberbox.core.files import sync_folder

FIRST_HASH = "0" * 64
CHECKPOINT = "checkpoint"
"""Kind of the first line of a manifest that was condensed: it goes on from the old one's end."""
_HASH_FIELD = 75  # {"hash":"<64 hex digits>",

Record = dict[str, Any]


@dataclass(slots=True)
class LineReader:
    """Takes complete lines as they come; gives the records whose hash holds."""

    last_hash: str = FIRST_HASH
    number: int = 0
    damage: list[str] = field(default_factory=list)

    def take(self, content: bytes, *, ends: bool = True) -> list[Record]:
        """Read lines; ``ends`` is false when the last of them may be torn."""
        lines = content.split(b"\n")
        records = []
        for place, line in enumerate(lines, 1):
            self.number += place < len(lines) or bool(line)
            record = self._record(line, torn=not ends and place == len(lines)) if line else None
            if record is not None:
                records.append(record)
        return records

    def _record(self, line: bytes, torn: bool) -> Record | None:
        record = decode(line)
        if record is None:
            why = "torn at the end" if torn else "damaged"
            self.damage.append(f"line {self.number}: {why}")
            return None
        begins = self.number == 1 and record["kind"] == CHECKPOINT
        if record["prev"] != self.last_hash and not begins:
            self.damage.append(f"line {self.number}: does not follow the line before")
        self.last_hash = record["hash"]
        return record


def decode(line: bytes) -> Record | None:
    """Read one line; None if its hash does not fit."""
    expected = b'{"hash":"%s",' % hashlib.sha256(line[_HASH_FIELD:]).hexdigest().encode()
    if line[:_HASH_FIELD] != expected:
        return None
    record: Record = json.loads(line)
    return record


def first_hash(path: Path) -> str:
    """Return the hash that the first line of a manifest states; empty where there is none."""
    try:
        with path.open("rb") as file:
            begin = file.read(_HASH_FIELD)
    except FileNotFoundError:
        return ""
    return begin[9:-2].decode("ascii", "replace") if len(begin) == _HASH_FIELD else ""


def encode(records: Sequence[Mapping[str, Any]], last_hash: str) -> bytes:
    """Write records as lines that follow the line with ``last_hash``."""
    lines = []
    for record in records:
        rest = json.dumps({"prev": last_hash, **record}, separators=(",", ":"))[1:].encode()
        last_hash = hashlib.sha256(rest).hexdigest()
        lines.append(b'{"hash":"%s",%s\n' % (last_hash.encode(), rest))
    return b"".join(lines)


def append_durably(path: Path, content: bytes) -> None:
    """Add lines to a file and sync it, on a new line should the last one be torn.

    Raises OSError when the disk does not take all: the file then ends where it ended before.
    """
    is_new = not path.exists()
    if not _ends_with_newline(path):
        content = b"\n" + content
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    size = os.fstat(descriptor).st_size
    try:
        while content:
            content = content[os.write(descriptor, content) :]
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, size)  # our own torn tail, nothing acknowledged
        raise
    finally:
        os.close(descriptor)
    if is_new:
        sync_folder(path.parent)


def _ends_with_newline(path: Path) -> bool:
    if not path.exists() or path.stat().st_size == 0:
        return True
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
