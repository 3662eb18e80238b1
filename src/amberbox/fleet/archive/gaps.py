"""What an archive lacks and why: never recorded, lost, deleted, refused, to come."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query import gaps as recorded
from amberbox.core.types import Gap
from amberbox.fleet.archive.catalogue import PUT, REFUSED, Catalogue, Source
from amberbox.fleet.archive.holes import REFUSED as WAS_REFUSED
from amberbox.fleet.archive.holes import Refused, holes, refusals
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.archive.store import LOST, Missing

Span = tuple[int | None, int | None]

WAITING = "on the server, its columns are to come"
OLD = "deleted: older than its lifetime"
_LOST = "lost at a power cut"


def gaps_of(
    reader: Reader, catalogue: Catalogue, item: str | None, span: Span,
    refused: Mapping[Source, Sequence[Refused]] | None = None, read: Collection[str] = (),
) -> list[Gap]:  # fmt: skip
    """List gaps that meet ``[from, to)`` of all stores, in order of time.

    ``refused`` are files that never came into the archive; ``read`` names those that wait for their
    columns (``store/folder/file``) and are no gap, as questions are answered from them, too.
    """
    found: list[Gap] = []
    for source in reader.sources:
        own = [n for n, v in reader.schemas.items() if v[-1].source == reserved.SOURCE]
        rows, missing = catalogue.journals(source), catalogue.missing(source)
        files = (refused or {}).get(source, ())
        then = [*_then(rows, missing, read), *refusals(files), *holes(rows, missing, files)]
        store = reader.of(source, *own) if own else reader.of(source, "")
        found += recorded.chosen(recorded.known(store, then), item, span)
    return sorted(found, key=lambda gap: (gap.from_ns, gap.to_ns, gap.item))


def _then(
    rows: Sequence[Row[Any]], missing: Sequence[Missing], read: Collection[str]
) -> Iterator[Gap]:
    for row in rows:
        facts = decode(row.facts)
        for gap in facts.gaps:
            yield Gap(row.writer, row.run, gap.from_ns, gap.to_ns, gap.reason, gap.item, gap.count,
                      gap.from_seq, gap.to_seq)  # fmt: skip
        if row.state == PUT:
            if f"{row.store_id}/{row.file}" not in read:
                yield _whole(row, WAITING)
        elif row.state == REFUSED:
            yield _whole(row, f"{WAS_REFUSED}{row.file}: {facts.refused}")
        elif row.columns_gone:
            yield _whole(row, OLD if row.raw_gone else f"{OLD}, the journal is kept")
    for one in missing:
        yield _said(one)


def _whole(row: Row[Any], reason: str) -> Gap:
    count = row.end_seq - row.first_seq
    return Gap(row.writer, row.run, row.start_ns, row.end_ns + 1, reason, "", count,
               row.first_seq, row.end_seq)  # fmt: skip


def _said(one: Missing) -> Gap:
    reason = _LOST if one.kind == LOST else "deleted on the robot before it was copied"
    text = f"{reason}: {one.reason}" if one.reason else reason
    return Gap(one.writer, one.run, one.from_ns, max(one.to_ns, one.from_ns + 1), text, "",
               one.to_seq - one.from_seq, one.from_seq, one.to_seq)  # fmt: skip
