"""What an archive lacks and why: never recorded, lost, deleted before or after it came, to come."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query import gaps as recorded
from amberbox.core.types import Gap
from amberbox.fleet.archive.catalogue import PUT, REFUSED, Catalogue
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.archive.store import LOST, Missing

Span = tuple[int | None, int | None]

TO_COME = "not on the server yet"
WAITING = "on the server, its columns are to come"
OLD = "deleted: older than its lifetime"
_LOST = "lost at a power cut"


def gaps_of(reader: Reader, catalogue: Catalogue, item: str | None, span: Span) -> list[Gap]:
    """List gaps that meet ``[from, to)`` of all stores, in order of time."""
    found: list[Gap] = []
    for source in reader.sources:
        own = [n for n, v in reader.schemas.items() if v[-1].source == reserved.SOURCE]
        then = list(_then(catalogue.journals(source), catalogue.missing(source)))
        store = reader.of(source, *own) if own else reader.of(source, "")
        found += recorded.chosen(recorded.known(store, then), item, span)
    return sorted(found, key=lambda gap: (gap.from_ns, gap.to_ns, gap.item))


def _then(rows: Sequence[Row[Any]], missing: Sequence[Missing]) -> Iterator[Gap]:
    for row in rows:
        facts = decode(row.facts)
        for gap in facts.gaps:
            yield Gap(row.writer, row.run, gap.from_ns, gap.to_ns, gap.reason, gap.item, gap.count,
                      gap.from_seq, gap.to_seq)  # fmt: skip
        if row.state == PUT:
            yield _whole(row, WAITING)
        elif row.state == REFUSED:
            yield _whole(row, f"refused: {facts.refused}")
        elif row.columns_gone:
            yield _whole(row, OLD if row.raw_gone else f"{OLD}, the journal is kept")
    for one in missing:
        yield _said(one)
    yield from _holes(rows, missing)


def _whole(row: Row[Any], reason: str) -> Gap:
    count = row.end_seq - row.first_seq
    return Gap(row.writer, row.run, row.start_ns, row.end_ns + 1, reason, "", count,
               row.first_seq, row.end_seq)  # fmt: skip


def _said(one: Missing) -> Gap:
    reason = _LOST if one.kind == LOST else "deleted on the robot before it was copied"
    text = f"{reason}: {one.reason}" if one.reason else reason
    return Gap(one.writer, one.run, one.from_ns, max(one.to_ns, one.from_ns + 1), text, "",
               one.to_seq - one.from_seq, one.from_seq, one.to_seq)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Stretch:
    """Rows that are here, or of which it is known why they are not."""

    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int


def _holes(rows: Sequence[Row[Any]], missing: Sequence[Missing]) -> Iterator[Gap]:
    """Find rows between those that are here of which nobody has said why they are not."""
    runs: dict[tuple[str, int], list[_Stretch]] = {}
    for row in rows:
        stretch = _Stretch(row.first_seq, row.end_seq, row.start_ns, row.end_ns)
        runs.setdefault((row.writer, row.run), []).append(stretch)
    for one in missing:
        stretch = _Stretch(one.from_seq, one.to_seq, one.from_ns, one.to_ns)
        runs.setdefault((one.writer, one.run), []).append(stretch)
    for (writer, run), stretches in runs.items():
        for gap in _between(sorted(stretches, key=lambda s: (s.from_seq, s.to_seq))):
            yield replace(gap, writer=writer, run=run)


def _between(stretches: Sequence[_Stretch]) -> Iterator[Gap]:
    reached, since_ns = 0, stretches[0].from_ns
    for stretch in stretches:
        if stretch.from_seq > reached:
            end_ns = max(stretch.from_ns, since_ns + 1)
            count = stretch.from_seq - reached
            yield Gap("", 0, since_ns, end_ns, TO_COME, "", count, reached, stretch.from_seq)
        if stretch.to_seq > reached:
            reached, since_ns = stretch.to_seq, stretch.to_ns
