"""Rows that an archive lacks and of which nobody said why: to come, or in a file that is no good.

A file that came and does not hold is refused. Mostly its robot's seal tells which rows it has;
where not even that holds, its name tells between which other files it stands.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Row

from amberbox.blackbox.store import run_and_number
from amberbox.core.types import Gap
from amberbox.fleet.archive.store import Missing

TO_COME = "not on the server yet"
REFUSED = "refused: "
"""How the reason of what was refused begins."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A file that came and does not hold; ``to_seq`` is 0 where nobody knows what is in it."""

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
class _Stretch:
    """Rows that are here, or of which it is known why they are not; ``number`` is their file's."""

    from_seq: int
    to_seq: int
    from_ns: int
    to_ns: int
    number: int | None = None


@dataclass(slots=True)
class _Run:
    """What is known of one run of a writer; ``lost`` are refused files without positions."""

    stretches: list[_Stretch] = field(default_factory=list)
    lost: list[Refused] = field(default_factory=list)


def refusals(files: Iterable[Refused]) -> Iterator[Gap]:
    """Yield the gaps of refused files of which it is known what is in them."""
    for one in files:
        if one.is_known:
            count = one.to_seq - one.from_seq
            yield Gap(one.writer, one.run, one.from_ns, max(one.to_ns, one.from_ns) + 1,
                      said_of([one]), "", count, one.from_seq, one.to_seq)  # fmt: skip


def said_of(files: Sequence[Refused]) -> str:
    """Name refused files, as the reason of a gap."""
    first = files[0]
    more = f", and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{REFUSED}{first.file}: {first.why}{more}"


def holes(
    rows: Sequence[Row[Any]], missing: Sequence[Missing], files: Sequence[Refused]
) -> Iterator[Gap]:
    """Find rows between those of which something is known, run by run."""
    runs = _runs(rows, missing, files)
    for (writer, number), run in runs.items():
        run.stretches.sort(key=lambda s: (s.from_seq, s.to_seq))
        next_ns = _next_ns(runs, writer, number) if run.lost else None
        for gap in (*_between(run), *_behind(run, next_ns)):
            yield replace(gap, writer=writer, run=number)


def _next_ns(runs: Mapping[tuple[str, int], _Run], writer: str, number: int) -> int | None:
    """Return when the next run of a writer begins."""
    later = [runs[name] for name in runs if name[0] == writer and name[1] > number]
    return min((s.from_ns for run in later for s in run.stretches), default=None)


def _runs(
    rows: Sequence[Row[Any]], missing: Sequence[Missing], files: Sequence[Refused]
) -> dict[tuple[str, int], _Run]:
    """Sort what is known by runs; a run of which nothing but refused files came has no times."""
    runs: dict[tuple[str, int], _Run] = {}
    for row in rows:
        _, number = run_and_number(Path(row.file))
        stretch = _Stretch(row.first_seq, row.end_seq, row.start_ns, row.end_ns, number)
        runs.setdefault((row.writer, row.run), _Run()).stretches.append(stretch)
    for one in missing:
        stretch = _Stretch(one.from_seq, one.to_seq, one.from_ns, one.to_ns)
        runs.setdefault((one.writer, one.run), _Run()).stretches.append(stretch)
    for file in files:
        run = runs.setdefault((file.writer, file.run), _Run())
        if file.is_known:
            stretch = _Stretch(file.from_seq, file.to_seq, file.from_ns, file.to_ns, file.number)
            run.stretches.append(stretch)
        else:
            run.lost.append(file)
    return {name: run for name, run in runs.items() if run.stretches}


def _between(run: _Run) -> Iterator[Gap]:
    reached, since_ns, last = 0, run.stretches[0].from_ns, -1
    for n, stretch in enumerate(run.stretches):
        if stretch.from_seq > reached:
            end_ns = max(stretch.from_ns, since_ns + 1)
            next_number = _next_number(run.stretches[n:])
            lost = [one for one in run.lost if last < one.number < next_number]
            hole = Gap("", 0, since_ns, end_ns, TO_COME, "", stretch.from_seq - reached, reached,
                       stretch.from_seq)  # fmt: skip
            yield from _explained(hole, lost, next_number - last - 1)
        if stretch.to_seq > reached:
            reached, since_ns = stretch.to_seq, stretch.to_ns
        last = max(last, -1 if stretch.number is None else stretch.number)


def _next_number(stretches: Sequence[_Stretch]) -> float:
    return next((s.number for s in stretches if s.number is not None), float("inf"))


def _explained(hole: Gap, lost: Sequence[Refused], files: float) -> Iterator[Gap]:
    """Say of a hole of so many files why it is one; where some are refused only, say both.

    Which part of it is whose nobody knows then: both reasons are of the whole, without a number.
    """
    if not lost:
        yield hole
    elif len(lost) == files:
        yield replace(hole, reason=said_of(lost))
    else:
        yield replace(hole, count=None)
        yield replace(hole, reason=said_of(lost), count=None, from_seq=None, to_seq=None)


def _behind(run: _Run, next_ns: int | None) -> Iterator[Gap]:
    """Say of refused files behind all others: they lie before the next run and their coming."""
    last = max((s.number for s in run.stretches if s.number is not None), default=-1)
    lost = [one for one in run.lost if one.number > last]
    if not lost:
        return
    since_ns = max(stretch.to_ns for stretch in run.stretches)
    came_ns = max(one.came_ns for one in lost)
    end_ns = came_ns if next_ns is None else min(came_ns, next_ns)
    yield Gap("", 0, since_ns, max(end_ns, since_ns + 1), said_of(lost), "", None)
