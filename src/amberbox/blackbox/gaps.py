"""What is missing from a record and why: recorded gaps, damage, deletions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from amberbox.blackbox.catalogue import Catalogue
from amberbox.blackbox.clocktable import ClockTable
from amberbox.blackbox.follow import follow
from amberbox.blackbox.gather import Span
from amberbox.blackbox.manifest import Manifest
from amberbox.blackbox.parquet import overlaps
from amberbox.core.types import Gap


def gaps(catalogue: Catalogue, item: str | None, span: Span) -> list[Gap]:
    """List gaps that meet ``[from, to)``, in order of time, of one item or of all."""
    known = [*_from_journals(catalogue), *_from_manifest(catalogue)]
    chosen = {_key(gap): gap for gap in known if _concerns(gap, item, span)}
    return sorted(chosen.values(), key=lambda gap: (gap.from_ns, gap.to_ns))


def _key(gap: Gap) -> tuple[object, ...]:
    return gap.writer, gap.run, gap.item, gap.from_ns, gap.reason


def _concerns(gap: Gap, item: str | None, span: Span) -> bool:
    return (item is None or gap.item in ("", item)) and overlaps(
        gap.from_ns, max(gap.to_ns - 1, gap.from_ns), span
    )


def _from_journals(catalogue: Catalogue) -> Iterator[Gap]:
    """Walk the journals without decoding messages; what lives on in segments is no gap."""
    if not catalogue.existing:
        return
    for delivery in follow(catalogue.store, items=(), live=False):
        if isinstance(delivery, Gap) and not _is_in_segments(delivery, catalogue):
            yield delivery


def _is_in_segments(gap: Gap, catalogue: Catalogue) -> bool:
    if gap.from_seq is None or gap.to_seq is None or not catalogue.with_segments:
        return False
    ranges = _ranges(catalogue.manifest, gap.writer, gap.run)
    reached = gap.from_seq
    for first, end in sorted(ranges):
        if first > reached:
            break
        reached = max(reached, end)
    return reached >= gap.to_seq


def _ranges(manifest: Manifest, writer: str, run: int) -> Iterable[tuple[int, int]]:
    """Return the ``seq`` ranges of journals that are in segments."""
    return (
        (journal.first_seq, journal.end_seq)
        for journal in manifest.journals.values()
        if (journal.writer, journal.run) == (writer, run)
    )


def _from_manifest(catalogue: Catalogue) -> Iterator[Gap]:
    for journal in catalogue.manifest.journals.values():
        if journal.name not in catalogue.existing:
            yield from journal.gaps
    for deletion in catalogue.manifest.deletions:
        for part in deletion.segment.parts:
            if part.journal not in catalogue.existing:
                yield Gap(
                    part.writer, part.run, part.from_ns, part.to_ns + 1,
                    f"deleted: {deletion.reason}", deletion.segment.item, part.rows,
                )  # fmt: skip


def last_received_ns(catalogue: Catalogue) -> int | None:
    """Return when the newest record was received."""
    ends = [
        segment.received_range_ns[1]
        for segments in catalogue.manifest.segments.values()
        for segment in segments
    ]
    for journal in catalogue.journals:
        if journal.rows:
            end = np.array([journal.end_ns])
            ends.append(int(ClockTable(journal.clock).received(end)[0]))
    return max(ends, default=None)
