"""Gaps of an archive and their reasons: not recorded, lost, deleted, refused, or yet to come."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query import gaps as recorded
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.store import run_and_number
from amberbox.core.types import Gap
from amberbox.server.archive.catalogue import PUT, ArchiveCatalogue, RobotStore
from amberbox.server.archive.catalogue import REFUSED as REFUSED_SOURCE
from amberbox.server.archive.reader import ArchiveReader, Span
from amberbox.server.journals import LOST, MissingRows, decode

TO_COME = "not on the server yet"
REFUSED = "refused: "
"""Beginning of the reason of a gap with refused data."""


@dataclass(frozen=True, slots=True)
class RefusedFile:
    """A received file that was refused; ``to_seq`` is 0 where its rows are unknown."""

    writer: str
    run: int
    number: int
    file: str
    why: str
    came_ns: int
    from_seq: int = 0
    to_seq: int = 0
    from_ns: int = 0
    to_ns: int = 0

    @property
    def is_known(self) -> bool:
        """Whether it is known which rows are in it."""
        return self.to_seq > self.from_seq


@dataclass(frozen=True, slots=True)
class _SeqRange:
    """A range of rows that exist or whose absence is explained; ``number`` is their file's."""

    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    number: int | None = None


@dataclass(slots=True)
class _Run:
    """The known ranges of one run of a writer; ``lost`` are refused files without positions."""

    seq_ranges: list[_SeqRange] = field(default_factory=list)
    lost: list[RefusedFile] = field(default_factory=list)


def refusals(files: Iterable[RefusedFile]) -> Iterator[Gap]:
    """Yield the gaps of refused files whose rows are known."""
    for one in files:
        if one.is_known:
            count = one.to_seq - one.from_seq
            yield Gap(one.writer, one.run, one.from_ns, max(one.to_ns, one.from_ns) + 1,
                      refusal_text([one]), "", count, one.from_seq, one.to_seq)  # fmt: skip


def refusal_text(files: Sequence[RefusedFile]) -> str:
    """Return the reason of a gap that names its refused files."""
    first = files[0]
    more = f", and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{REFUSED}{first.file}: {first.why}{more}"


def holes(
    rows: Sequence[Row[Any]], missing: Sequence[MissingRows], files: Sequence[RefusedFile]
) -> Iterator[Gap]:
    """Yield the gaps between known ranges of rows, run by run."""
    runs = _runs(rows, missing, files)
    for (writer, number), run in runs.items():
        run.seq_ranges.sort(key=lambda s: (s.from_seq, s.to_seq))
        later = [r for (w, n), r in runs.items() if w == writer and n > number] if run.lost else []
        next_ns = min((s.from_ns for r in later for s in r.seq_ranges), default=None)
        for gap in (*_between(run), *_behind(run, next_ns)):
            yield replace(gap, writer=writer, run=number)


def _runs(
    rows: Sequence[Row[Any]], missing: Sequence[MissingRows], files: Sequence[RefusedFile]
) -> dict[tuple[str, int], _Run]:
    """Group known ranges by run; runs with refused files only are left out, having no times."""
    runs: dict[tuple[str, int], _Run] = {}
    for row in rows:
        _, number = run_and_number(Path(row.file))
        seq_range = _SeqRange(row.first_seq, row.end_seq, row.start_ns, row.end_ns, number)
        runs.setdefault((row.writer, row.run), _Run()).seq_ranges.append(seq_range)
    for one in missing:
        seq_range = _SeqRange(one.from_seq, one.to_seq, one.from_ns, one.to_ns)
        runs.setdefault((one.writer, one.run), _Run()).seq_ranges.append(seq_range)
    for file in files:
        run = runs.setdefault((file.writer, file.run), _Run())
        if file.is_known:
            seq_range = _SeqRange(file.from_seq, file.to_seq, file.from_ns, file.to_ns, file.number)
            run.seq_ranges.append(seq_range)
        else:
            run.lost.append(file)
    return {name: run for name, run in runs.items() if run.seq_ranges}


def _between(run: _Run) -> Iterator[Gap]:
    reached, since_ns, last = 0, run.seq_ranges[0].from_ns, -1
    for n, seq_range in enumerate(run.seq_ranges):
        if seq_range.from_seq > reached:
            end_ns = max(seq_range.from_ns, since_ns + 1)
            numbers = (s.number for s in run.seq_ranges[n:] if s.number is not None)
            next_number = next(numbers, float("inf"))
            lost = [one for one in run.lost if last < one.number < next_number]
            hole = Gap("", 0, since_ns, end_ns, TO_COME, "", seq_range.from_seq - reached, reached,
                       seq_range.from_seq)  # fmt: skip
            yield from _explained(hole, lost, next_number - last - 1)
        if seq_range.to_seq > reached:
            reached, since_ns = seq_range.to_seq, seq_range.to_ns
        last = max(last, -1 if seq_range.number is None else seq_range.number)


def _explained(hole: Gap, lost: Sequence[RefusedFile], files: float) -> Iterator[Gap]:
    """Yield a gap, explained by refused files if there are any.

    If only some of its ``files`` were refused, the whole gap is yielded for both reasons, without
    counts, since it is unknown which part belongs to which.
    """
    if not lost:
        yield hole
    elif len(lost) == files:
        yield replace(hole, reason=refusal_text(lost))
    else:
        yield replace(hole, count=None)
        yield replace(hole, reason=refusal_text(lost), count=None, from_seq=None, to_seq=None)


def _behind(run: _Run, next_ns: int | None) -> Iterator[Gap]:
    """Yield the gap of refused files after the last row, up to the next run or their arrival."""
    last = max((s.number for s in run.seq_ranges if s.number is not None), default=-1)
    lost = [one for one in run.lost if one.number > last]
    if not lost:
        return
    since_ns = max(seq_range.to_ns for seq_range in run.seq_ranges)
    came_ns = max(one.came_ns for one in lost)
    end_ns = came_ns if next_ns is None else min(came_ns, next_ns)
    yield Gap("", 0, since_ns, max(end_ns, since_ns + 1), refusal_text(lost), "", None)


WAITING = "on the server, its columns are to come"
OLD = "deleted: older than its lifetime"
_LOST = "lost at a power cut"


def gaps_of(
    reader: ArchiveReader, catalogue: ArchiveCatalogue, item: str | None, span: Span,
    refused: Mapping[RobotStore, Sequence[RefusedFile]] | None = None,
    waiting: Mapping[RobotStore, Sequence[JournalFile]] | None = None,
) -> list[Gap]:  # fmt: skip
    """Return the gaps that overlap ``[from, to)`` of all stores, in order of time.

    ``refused`` are files that are not in the archive. ``waiting`` are journals that wait for their
    columns, and that queries read too: they are no gap, and the gaps recorded in them count.
    """
    found: list[Gap] = []
    for source in reader.sources:
        own = [n for n, v in reader.schemas.items() if v[-1].source == channels.SOURCE]
        rows, missing = catalogue.journals(source), catalogue.missing(source)
        files, journals = (refused or {}).get(source, ()), (waiting or {}).get(source, ())
        read = {journal.name for journal in journals}
        then = [*_then(rows, missing, read), *refusals(files), *holes(rows, missing, files)]
        store = reader.with_journals(source, journals, *(own or [""]))
        found += recorded.joined_gaps_in(recorded.recorded_and_known(store, then), item, span)
    return sorted(found, key=lambda gap: (gap.from_ns, gap.to_ns, gap.item))


def _then(
    rows: Sequence[Row[Any]], missing: Sequence[MissingRows], read: Collection[str]
) -> Iterator[Gap]:
    for row in rows:
        facts = decode(row.facts)
        for gap in facts.gaps:
            yield Gap(row.writer, row.run, gap.from_ns, gap.to_ns, gap.reason, gap.item, gap.count,
                      gap.from_seq, gap.to_seq)  # fmt: skip
        if row.state == PUT:
            if row.file not in read:
                yield _whole(row, WAITING)
        elif row.state == REFUSED_SOURCE:
            yield _whole(row, f"{REFUSED}{row.file}: {facts.refused}")
        elif row.columns_gone:
            yield _whole(row, OLD if row.raw_gone else f"{OLD}, the journal is kept")
    for one in missing:
        reason = _LOST if one.kind == LOST else "deleted on the robot before it was copied"
        text = f"{reason}: {one.reason}" if one.reason else reason
        yield Gap(one.writer, one.run, one.from_ns, max(one.to_ns, one.from_ns + 1), text, "",
                  one.to_seq - one.from_seq, one.from_seq, one.to_seq)  # fmt: skip


def _whole(row: Row[Any], reason: str) -> Gap:
    count = row.end_seq - row.first_seq
    return Gap(row.writer, row.run, row.start_ns, row.end_ns + 1, reason, "", count,
               row.first_seq, row.end_seq)  # fmt: skip
