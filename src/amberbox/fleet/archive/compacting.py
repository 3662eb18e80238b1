"""Compaction: many small files of one day become few large ones; no row changes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from amberbox.fleet.archive.catalogue import Catalogue
from amberbox.fleet.archive.files import Layout, tables_of
from amberbox.fleet.archive.log import LiveFile
from amberbox.fleet.archive.segments import joined

SMALL_BYTES = 32 << 20
FULL_BYTES = 128 << 20
COUNT = 8
"""So many small files of a day that still grows are joined; of a day that is over, any two."""

_LOG = logging.getLogger(__name__)


def compact(layout: Layout, catalogue: Catalogue) -> int:
    """Join small files of all tables; each join is one commit. Return how many files went."""
    from amberbox.fleet.archive import delta

    gone = 0
    for table, schema in (pair for known in catalogue.schemas() for pair in tables_of(known)):
        files = list(layout.snapshot(table).files.values())
        for group in groups(files):
            try:
                made = joined(layout.tables, table, schema, group)
            except MemoryError:  # they stay small files, and all other tables are joined
                _LOG.warning("%s: %d files are too large to be joined", table, len(group))
                continue
            assert made is not None  # nothing was left out
            about = f"joined {len(group)} files"
            folder = layout.table(table)
            delta.change(folder, schema, [made], group, same_rows=True, about=about)
            gone += len(group)
    return gone


def groups(files: Sequence[LiveFile]) -> Iterator[list[LiveFile]]:
    """Choose which files are joined: small ones of one store, writer and day, by age."""
    newest = {file.robot: file.day for file in sorted(files, key=lambda file: file.day)}
    by_place: dict[tuple[str, ...], list[LiveFile]] = {}
    for file in files:
        if file.bytes < SMALL_BYTES:
            place = (file.robot, file.day, file.low["store_id"], file.low["writer"])
            by_place.setdefault(place, []).append(file)
    for (robot, day, *_), found in sorted(by_place.items()):
        enough = COUNT if day == newest[robot] else 2
        for group in _full(sorted(found, key=lambda f: (f.low["run"], f.low["log_time"], f.path))):
            if len(group) >= enough:
                yield group


def _full(files: Sequence[LiveFile]) -> Iterator[list[LiveFile]]:
    group: list[LiveFile] = []
    for file in files:
        if group and sum(f.bytes for f in group) + file.bytes > FULL_BYTES:
            yield group
            group = []
        group.append(file)
    if group:
        yield group
