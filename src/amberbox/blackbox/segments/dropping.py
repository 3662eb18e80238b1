"""Take the rows of journals whose columns were deleted out of segments that hold others, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.build import (
    group_starts,
    is_partly_gone,
    put_in_place_of,
    segment_path,
)
from amberbox.blackbox.segments.flat import Flat
from amberbox.blackbox.segments.manifest import Part, Segment
from amberbox.blackbox.segments.parquet import TableFile, read_segment


def drop_gone(store: Path, breathe: Callable[[], None]) -> int:
    """Write segments that were joined anew without the journals whose columns were deleted."""
    count = 0
    for item in mf.read(store).segments:
        breathe()  # which may delete segments
        known = mf.read(store)
        for segment in known.segments.get(item, ()):
            if is_partly_gone(segment, known):
                with suppress(FileNotFoundError):  # deleted for room meanwhile
                    count += _rewrite(store, known, segment)
    return count


def _rewrite(store: Path, known: mf.Manifest, segment: Segment) -> bool:
    """Replace a segment by its rows of the journals that still have columns."""
    schema = known.schemas[segment.schema]
    parts = [part for part in segment.parts if part.journal not in known.columns_gone]
    names = {column.name for column in schema.columns}
    flats = [f for f in read_segment(store, segment, schema, names) if _is_of(f, parts)]
    file = TableFile(store, _path_without(segment, parts), schema)
    try:
        for rows in group_starts(flats):
            file.write(rows)
        rest = file.finish(parts)
    finally:
        file.discard()
    return put_in_place_of(store, rest, [segment])


def _is_of(flat: Flat, parts: Sequence[Part]) -> bool:
    first = int(flat.seq[0])
    return any(p.run == flat.run and p.first_seq <= first <= p.last_seq for p in parts)


def _path_without(segment: Segment, parts: Sequence[Part]) -> str:
    """Name what is left of a segment by its first journal, schema version and number of parts."""
    stem = Path(segment.path).stem.partition("+")[0]
    version = stem.partition(".")[2]
    first = Path(segment_path(segment.item, parts[0].journal, int(version or 1)))
    return str(first.with_name(f"{first.stem}+{len(parts)}.parquet"))
