"""Lines of the manifest: JSON objects, each of which states the hash of the one before."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.files import sync_folder

FIRST_HASH = "0" * 64
TORN = "torn at the end"
"""Why a last line without its newline cannot be read: a crash or power cut left it so."""
CHECKPOINT = "checkpoint"
"""Kind of the first line of a manifest that was condensed: it goes on from the old one's end."""
_BEGIN = b'{"hash":"'
_HASH_FIELD = 75  # {"hash":"<64 hex digits>",
_MOST_BYTES = 16_000
"""Longer lines are not searched for a flipped bit: it would take seconds each."""

NONSENSE = "cannot be understood"
"""Why a line counts for nothing although its hash holds: it does not say what its kind should."""
Record = dict[str, Any]
MALFORMED = (msgspec.MsgspecError, ValueError, KeyError, TypeError, AttributeError)
"""What a record raises whose hash holds, but that says something else than its kind should."""


@dataclass(slots=True)
class Patience:
    """How many more bytes may be hashed in search of flipped bits: some seconds in all."""

    bytes: int = 2_000_000_000

    def allows(self, size: int) -> bool:
        """Take the cost of one search in a line of `size` bytes; false when it is too much."""
        cost = 4 * size * size  # each of 8 * size bits, with half of the line behind it
        if size > _MOST_BYTES or cost > self.bytes:
            return False
        self.bytes -= cost
        return True


@dataclass(frozen=True, slots=True)
class Line:
    """A line of the manifest as it stands in the file.

    ``records`` are those whose hash holds: two if a bit flip took the newline between them, none
    if the line is ``damaged`` beyond repair. ``size`` includes the newline, ``count`` is how many
    lines the file shows for it: two if a bit flip made a newline. ``mended`` is its content
    before one bit was flipped, empty if it is as it was written.
    """

    number: int
    offset: int
    size: int
    records: tuple[Record, ...]
    count: int = 1
    mended: bytes = b""

    @property
    def damaged(self) -> bool:
        """Tell whether no record could be read from it."""
        return not self.records


def split(content: bytes, number: int = 1, patience: Patience | None = None) -> Iterator[Line]:
    """Give the lines of a manifest, each with its records; one flipped bit per line is undone.

    ``number`` is that of the first line. Empty lines are left out, but counted.
    """
    patience = patience or Patience()
    pieces = content.split(b"\n")
    place, offset = 0, 0
    while place < len(pieces):
        piece, taken = pieces[place], 1
        record = decode(piece) if piece else None
        mended: list[bytes] = []
        if piece and record is None:
            mended, taken = _mended(pieces, place, patience)
        size = sum(len(part) + 1 for part in pieces[place : place + taken])
        if piece:
            records = [record] if record is not None else [decode(part) for part in mended]
            whole = tuple(found for found in records if found is not None)
            yield Line(number + place, offset, size, whole, taken, b"\n".join(mended))
        place, offset = place + taken, offset + size


def _mended(pieces: Sequence[bytes], place: int, patience: Patience) -> tuple[list[bytes], int]:
    """Undo one flipped bit: in a line, in a line's end, or where it became a line's end."""
    piece = pieces[place]
    cut = piece.find(_BEGIN, 1)
    if cut > 0 and decode(piece[: cut - 1]) is not None and decode(piece[cut:]) is not None:
        return [piece[: cut - 1], piece[cut:]], 1
    if place + 1 < len(pieces) and not pieces[place + 1].startswith(_BEGIN):
        for bit in range(8):
            whole = piece + bytes([ord("\n") ^ 1 << bit]) + pieces[place + 1]
            if decode(whole) is not None:
                return [whole], 2
    found = _without_flip(piece) if patience.allows(len(piece)) else None
    return ([], 1) if found is None or decode(found) is None else ([found], 1)


def _without_flip(line: bytes) -> bytes | None:
    """Return a line as it was before one bit of it was flipped; None if more was changed."""
    head, body = line[:_HASH_FIELD], line[_HASH_FIELD:]
    expected = _BEGIN + hashlib.sha256(body).hexdigest().encode() + b'",'
    if len(head) == len(expected):
        difference = int.from_bytes(head, "big") ^ int.from_bytes(expected, "big")
        if difference.bit_count() == 1:
            return expected + body
    wanted = head[len(_BEGIN) : -2].decode("ascii", "replace")
    before = hashlib.sha256()
    for place, byte in enumerate(body):
        rest = body[place + 1 :]
        for bit in range(8):
            tried = before.copy()
            tried.update(bytes([byte ^ 1 << bit]) + rest)
            if tried.hexdigest() == wanted:
                return head + body[:place] + bytes([byte ^ 1 << bit]) + rest
        before.update(body[place : place + 1])
    return None


@dataclass(slots=True)
class LineReader:
    """Takes complete lines as they come; gives the records whose hash holds, one bit mended.

    ``damage`` names the lines that cannot be read, ``mended`` those of which one bit is flipped.
    """

    last_hash: str = FIRST_HASH
    number: int = 0
    damage: list[str] = field(default_factory=list)
    mended: list[str] = field(default_factory=list)
    patience: Patience = field(default_factory=Patience)

    def take(self, content: bytes, *, ends: bool = True) -> Iterator[tuple[int, Record]]:
        """Read lines with their numbers; ``ends`` is false when the last of them may be torn."""
        first = self.number + 1
        lines = content.split(b"\n")
        last = self.number + len(lines)
        self.number = last if lines[-1] else last - 1
        for line in split(content, first, self.patience):
            if line.damaged:
                torn = not ends and line.number == last
                self.damage.append(
                    f"line {line.number}: {'torn at the end' if torn else 'damaged'}"
                )
            elif line.mended:
                self.mended.append(f"line {line.number}: one bit is flipped")
            for record in line.records:
                begins = line.number == 1 and record["kind"] == CHECKPOINT
                if record["prev"] != self.last_hash and not begins:
                    self.damage.append(f"line {line.number}: does not follow the line before")
                self.last_hash = record["hash"]
                yield line.number, record


def decode(line: bytes) -> Record | None:
    """Read one line; None if its hash does not fit, or if it is no record."""
    expected = b'{"hash":"%s",' % hashlib.sha256(line[_HASH_FIELD:]).hexdigest().encode()
    if line[:_HASH_FIELD] != expected:
        return None
    try:
        record: Record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    texts = (record.get("kind"), record.get("prev"))
    return record if all(isinstance(text, str) for text in texts) else None


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
