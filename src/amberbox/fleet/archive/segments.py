"""Files of tables as the segments that the black box's readers know."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from pathlib import Path

from amberbox.blackbox.segments.flat import Flat, TableSchema
from amberbox.blackbox.segments.manifest import Part, Segment, part_from_json
from amberbox.blackbox.segments.parquet import METADATA, read_segment
from amberbox.fleet.archive.catalogue import Source
from amberbox.fleet.archive.layout import stored_name
from amberbox.fleet.archive.log import LiveFile
from amberbox.fleet.archive.writing import FileBuilder, Place


@lru_cache(maxsize=4096)
def segment_at(tables: Path, path: str) -> Segment:
    """Describe a file by what stands at its end; files never change.

    Raises FileNotFoundError for one that has been replaced meanwhile.
    """
    import pyarrow.parquet as pq

    metadata = pq.read_metadata(tables / path)
    data = json.loads(metadata.metadata[METADATA])
    schema = TableSchema.from_json(data["schema"])
    parts = tuple(part_from_json(part) for part in data["parts"])
    size = (tables / path).stat().st_size
    return Segment(path, schema.item, schema.id, int(metadata.num_rows), size, "", parts)


def rows_of(
    tables: Path, table: str, file: LiveFile, schema: TableSchema
) -> Iterator[tuple[Flat, Part]]:
    """Give all rows of a file, part by part."""
    segment = segment_at(tables, f"{table}/{file.path}")
    names = {column.name for column in schema.columns}
    flats = read_segment(tables, segment, schema, names, stored=stored_name)
    yield from zip(flats, segment.parts, strict=True)


def joined(
    tables: Path,
    table: str,
    schema: TableSchema,
    files: Iterable[LiveFile],
    without: Collection[str] = (),
) -> LiveFile | None:
    """Write files of one store and day as one, but the rows of journals that are to go.

    The name follows from what is in it: done again after a crash it is the same.
    """
    chosen = sorted(files, key=lambda file: (file.low["run"], file.low["log_time"], file.path))
    kept = [
        (file, {p.journal for p in segment_at(tables, f"{table}/{file.path}").parts} - {*without})
        for file in chosen
    ]
    if not any(names for _, names in kept):
        return None
    first = chosen[0]
    source = Source(first.robot, first.low["store_id"])
    text = json.dumps([(file.path, sorted(names)) for file, names in kept])
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    builder = FileBuilder(tables, Place(table, source, first.day, f"joined-{digest}"), schema)
    try:
        for file, names in kept:
            for flat, part in rows_of(tables, table, file, schema) if names else ():
                if part.journal in names:
                    builder.add_part(flat, part)
        return builder.finish()
    finally:
        builder.discard()
