"""Lines of the manifest: JSON objects, each of which states the hash of the one before.

``GrowingLines`` reads a file that grows, each line once.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Generic, Protocol, TypeVar

import msgspec

from amberbox.core.files import sync_folder, write_all

FIRST_HASH = "0" * 64
# Why a last line without its newline cannot be read: a crash or power cut left it so
TORN = "torn at the end"
# Kind of the first line of a condensed manifest: it continues from the old one's end
CHECKPOINT = "checkpoint"
_BEGIN = b'{"hash":"'
_HASH_FIELD = 75  # {"hash":"<64 hex digits>",
_MOST_BYTES = 16_000  # longer lines are not searched for a flipped bit: it would take seconds each

# Why a line is ignored although its hash holds: its content does not fit its kind
NONSENSE = "cannot be understood"
LineRecord = dict[str, Any]
# Errors of a record whose hash is right, but whose content does not fit its kind
MALFORMED = (msgspec.MsgspecError, ValueError, KeyError, TypeError, AttributeError)


@dataclass(slots=True)
class RepairBudget:
    """Number of bytes that may still be hashed in search of flipped bits: some seconds in all."""

    bytes: int = 2_000_000_000

    def allows(self, size: int) -> bool:
        """Charge one search in a line of `size` bytes; return False when it is too much."""
        cost = 4 * size * size  # each of 8 * size bits, with half of the line behind it
        if size > _MOST_BYTES or cost > self.bytes:
            return False
        self.bytes -= cost
        return True


@dataclass(frozen=True, slots=True)
class ManifestLine:
    """A line of the manifest in the file.

    ``records`` are those whose hash is right: two if a bit flip removed the newline between them,
    none if the line is ``damaged`` beyond repair. ``size`` includes the newline, ``count`` is the
    number of lines that the file shows for it: two if a bit flip made a newline. ``mended`` is the
    repaired content if one bit was flipped, else empty.
    """

    number: int
    offset: int
    size: int
    records: tuple[LineRecord, ...]
    count: int = 1
    mended: bytes = b""

    @property
    def damaged(self) -> bool:
        """Return whether no record could be read from it."""
        return not self.records


def split(
    content: bytes, number: int = 1, patience: RepairBudget | None = None
) -> Iterator[ManifestLine]:
    """Yield the lines of a manifest, each with its records; one flipped bit per line is undone.

    ``number`` is that of the first line. Empty lines are left out, but counted.
    """
    patience = patience or RepairBudget()
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
            yield ManifestLine(number + place, offset, size, whole, taken, b"\n".join(mended))
        place, offset = place + taken, offset + size


def _mended(pieces: Sequence[bytes], place: int, patience: RepairBudget) -> tuple[list[bytes], int]:
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
    """Return a line with its one flipped bit corrected; None if more than one bit differs."""
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
    """Reader of complete lines; it returns the records whose hash is right after correcting one
    bit.

    ``damage`` names the lines that cannot be read, ``mended`` those with one flipped bit.
    """

    last_hash: str = FIRST_HASH
    number: int = 0
    damage: list[str] = field(default_factory=list)
    mended: list[str] = field(default_factory=list)
    patience: RepairBudget = field(default_factory=RepairBudget)

    def take(self, content: bytes, *, ends: bool = True) -> Iterator[tuple[int, LineRecord]]:
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


def decode(line: bytes) -> LineRecord | None:
    """Read one line; None if its hash does not fit, or if it is no record."""
    expected = b'{"hash":"%s",' % hashlib.sha256(line[_HASH_FIELD:]).hexdigest().encode()
    if line[:_HASH_FIELD] != expected:
        return None
    try:
        record: LineRecord = json.loads(line)
    except (ValueError, RecursionError):
        return None
    texts = (record.get("kind"), record.get("prev"))
    return record if all(isinstance(text, str) for text in texts) else None


def first_hash(path: Path) -> str:
    """Return the hash in the first line of a manifest; empty without one."""
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

    Raises OSError when writing fails: the file then ends where it ended before.
    """
    is_new = not path.exists()
    if not _ends_with_newline(path):
        content = b"\n" + content
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    size = os.fstat(descriptor).st_size
    try:
        write_all(descriptor, content)
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


Result = TypeVar("Result")
Result_co = TypeVar("Result_co", covariant=True)


class LineState(Protocol[Result_co]):
    """The state after the lines read so far."""

    def take(self, record: Mapping[str, Any]) -> None:
        """Add one record."""

    def result(self, read: LineReader) -> Result_co:
        """Return a snapshot that later records do not change."""


class GrowingLines(Generic[Result]):
    """Reads one file, and later only lines appended since; a replaced file is read again."""

    def __init__(self, path: Path, begin: Callable[[], LineState[Result]]) -> None:
        self._path = path
        self._begin = begin
        self._nothing = begin().result(LineReader())
        self._lock = threading.Lock()
        self._start_again()

    def _start_again(self) -> None:
        self._state, self._lines = self._begin(), LineReader()
        self._size, self._last_line = 0, b""
        self._seen: tuple[int, int, int] | None = None
        self._result = self._nothing

    def read(self) -> Result:
        """Return the present content of the file; the empty state if it does not exist."""
        with self._lock:
            try:
                with self._path.open("rb") as file:
                    return self._read(file)
            except FileNotFoundError:
                return self._nothing

    def _read(self, file: BinaryIO) -> Result:
        status = os.fstat(file.fileno())
        seen = (status.st_ino, status.st_mtime_ns, status.st_size)
        if seen != self._seen:
            if not self._goes_on(file, status):
                self._start_again()
            file.seek(self._size)
            whole, newline, torn = file.read().rpartition(b"\n")
            if newline:
                _take(self._state, self._lines, self._lines.take(whole))
                self._size += len(whole) + 1
                self._last_line = whole[whole.rfind(b"\n") + 1 :] + newline
            self._result = self._with_torn(file) if torn else self._state.result(self._lines)
            self._seen = seen
        return self._result

    def _goes_on(self, file: BinaryIO, status: os.stat_result) -> bool:
        """Return whether the file is the one read before, with lines added."""
        if self._seen is None or status.st_ino != self._seen[0] or status.st_size <= self._size:
            return False
        file.seek(self._size - len(self._last_line))
        return file.read(len(self._last_line)) == self._last_line

    def _with_torn(self, file: BinaryIO) -> Result:
        """Return the result with the torn end, without keeping it: the end may still change."""
        file.seek(0)
        state, reader = self._begin(), LineReader()
        _take(state, reader, reader.take(file.read(), ends=False))
        return state.result(reader)


def _take(
    state: LineState[Any], reader: LineReader, records: Iterable[tuple[int, LineRecord]]
) -> None:
    """Add records; one that cannot be understood although its hash holds is named as damage."""
    for number, record in records:
        try:
            state.take(record)
        except MALFORMED:
            reader.damage.append(f"line {number}: {NONSENSE}")
