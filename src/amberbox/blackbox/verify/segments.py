"""Check the columns: each Parquet file against the hash that the manifest states."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from amberbox.blackbox.segments.build import can_build
from amberbox.blackbox.segments.entries import Sealed
from amberbox.blackbox.segments.manifest import Segment
from amberbox.blackbox.verify.findings import Finding, State
from amberbox.blackbox.verify.mended import without_one_bit

_MOST_HASHED_BYTES = 3_000_000_000
"""How much may be hashed in search of a flipped bit: some ten seconds."""
_PAGE_HEAD_BYTES = 100


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
    if can_build() and _one_bit(path, segment.sha256):
        return _finding("damaged", segment, "one bit around its pages is flipped")
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
    """Tell whether one bit outside the checksums (footer, heads of pages) makes the difference."""
    content = path.read_bytes()
    left = _MOST_HASHED_BYTES
    for start, end in _unchecked(path, content):
        left -= 8 * (end - start) * (len(content) - start)
        if left < 0:
            break
        rest = content[end:]
        holds = _ends_in(hashlib.sha256(content[:start]), rest, sha256)
        if without_one_bit(content[start:end], holds) is not None:
            return True
    return False


def _unchecked(path: Path, content: bytes) -> Iterator[tuple[int, int]]:
    """Give the parts of a Parquet file that have no checksum, from its end on."""
    length = int.from_bytes(content[-8:-4], "little") + 8
    footer = max(len(content) - length, 0)
    yield footer, len(content)
    for start in sorted(_page_starts(path), reverse=True):
        yield start, min(start + _PAGE_HEAD_BYTES, len(content))


def _page_starts(path: Path) -> Iterator[int]:
    """Give where the first pages of each column begin."""
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(path)
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            column = metadata.row_group(group).column(number)
            yield column.data_page_offset
            if column.dictionary_page_offset is not None:
                yield column.dictionary_page_offset


def _ends_in(before: hashlib._Hash, rest: bytes, sha256: str) -> Callable[[bytes], bool]:
    def holds(part: bytes) -> bool:
        whole = before.copy()
        whole.update(part + rest)
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
