"""Check the columns: each Parquet file against the hash that the manifest states."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path

from amberbox.blackbox.segments.build import can_build
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.segments.manifest import Segment
from amberbox.blackbox.verify.findings import Finding, State
from amberbox.blackbox.verify.mended import without_one_bit

_FOOTER_BYTES = 24_000
"""A larger end of a Parquet file is not searched for a flipped bit: it would take minutes."""


def check_segment(
    store: Path, segment: Segment, sealed: Mapping[str, Sealed], by_hash: Mapping[str, str]
) -> tuple[list[Finding], int]:
    """Hash a segment; return what is wrong with it, and its size.

    ``by_hash`` names the segment that each hash belongs to.
    """
    path = store / segment.path
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            size = file.tell()
    except FileNotFoundError:
        return [_finding("missing", segment, f"is gone: {segment.rows} rows")], 0
    if digest != segment.sha256:
        return [_changed(path, segment, size, by_hash.get(digest))], size
    return _other_source(segment, sealed), size


def _finding(state: State, segment: Segment, text: str) -> Finding:
    from_ns, to_ns = segment.received_range_ns
    return Finding(state, segment.path, text, None, 0, segment.bytes, from_ns, to_ns, segment.item)


def _changed(path: Path, segment: Segment, size: int, other: str | None) -> Finding:
    """Tell why a segment has another hash."""
    if other is not None:
        return _finding("missing", segment, f"is not there: under its name lies {other}")
    if size < segment.bytes:
        return _finding("missing", segment, f"the last {segment.bytes - size} bytes were cut off")
    if size > segment.bytes:
        return _finding("altered", segment, f"{size - segment.bytes} bytes were added")
    if not _readable(path):
        return _finding("damaged", segment, "a page does not match its checksum")
    if _one_bit(path, segment.sha256):
        return _finding("damaged", segment, "one bit of its footer is flipped")
    return _finding("altered", segment, "its checksums hold, but it is not the file it was")


def _readable(path: Path) -> bool:
    """Read all pages with their checksums; without pyarrow nobody can tell."""
    if not can_build():
        return True
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            for batch in file.iter_batches():
                batch.validate()
    except (pa.ArrowException, OSError, ValueError):
        return False
    return True


def _one_bit(path: Path, sha256: str) -> bool:
    """Tell whether one bit of the end of the file, which has no checksum, makes the difference."""
    content = path.read_bytes()
    length = int.from_bytes(content[-8:-4], "little") + 8
    start = len(content) - min(length, len(content))
    if length > _FOOTER_BYTES:
        return False
    before = hashlib.sha256(content[:start])
    return without_one_bit(content[start:], _ends_in(before, sha256)) is not None


def _ends_in(before: hashlib._Hash, sha256: str) -> Callable[[bytes], bool]:
    def holds(end: bytes) -> bool:
        whole = before.copy()
        whole.update(end)
        return whole.hexdigest() == sha256

    return holds


def _other_source(segment: Segment, sealed: Mapping[str, Sealed]) -> list[Finding]:
    """Compare the journal that columns came from with the one that was sealed."""
    for part in segment.parts:
        entry = sealed.get(part.journal)
        if entry is not None and part.head and part.head != entry.chain:
            text = f"was not made from {part.journal} as it was sealed"
            return [_finding("altered", segment, text)]
    return []
