"""What a store knows about its clocks by now: times that were wrong when written, put right.

Within one boot the wall clock minus the time since boot is one continuous function, cut by steps.
The newest stretch known to be synchronised is right (else the newest); the others are moved so
that there is no step. Nothing is rewritten: whoever reads asks the book. The reasons stand in
``docs/notes/004-clock-steps.md``.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter

import numpy as np

from amberbox.blackbox.journal.clocktable import (
    STEP_NS,
    ClockPoints,
    ClockReading,
    ClockTable,
    simplified,
)
from amberbox.core.types import IntArray

UNKNOWN_BOOT = "00000000"
"""The name of a boot in files of writers that do not know it."""

MARGIN_NS = 15_000_000_000
"""A file may go on for this long after its last reading of the clock."""

_SLEW = 500e-6
"""The kernel turns the wall clock faster or slower by at most this while it follows a reference."""

_RATE_SPAN_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class JournalClock:
    """What one journal file says about the clocks of its computer."""

    name: str
    boot: str
    run: int
    readings: tuple[ClockReading, ...]

    @property
    def base_ns(self) -> int | None:
        """Log time minus time since boot; None where the file does not say."""
        known = (r.log_ns - r.boot_ns for r in self.readings if r.boot_ns is not None)
        return next(known, None) if self.boot != UNKNOWN_BOOT else None


@dataclass(frozen=True, slots=True)
class BootClock:
    """The wall clock of one boot, as far as it is known now.

    ``points`` are (time since boot, wall clock minus that); ``synchronised`` says whether the
    wall clock was ever known to be right, None if nobody could know.
    """

    boot: str
    runs: tuple[int, ...]
    points: ClockPoints
    synchronised: bool | None
    largest_step_ns: int = 0

    def wall_ns(self, boot_ns: int) -> int:
        """Return the wall clock at a time since boot."""
        return ClockTable(self.points).at(boot_ns)


@dataclass(frozen=True, slots=True)
class Epoch:
    """A stretch of log time within a run that has one base."""

    boot: str
    run: int
    base_ns: int
    from_ns: int
    to_ns: int
    points: ClockPoints


@dataclass(frozen=True, slots=True)
class ClockBook:
    """The clocks of all boots in a store, and which journal was written in which."""

    boots: Mapping[str, BootClock] = field(default_factory=dict)
    journals: Mapping[str, Epoch] = field(default_factory=dict)

    def points(self, journal: str) -> ClockPoints | None:
        """Return the corrected points of a journal; None where nothing is known better."""
        if journal not in self.journals:
            return None
        epoch = self.journals[journal]
        points, base_ns = self.boots[epoch.boot].points, epoch.base_ns
        first = bisect_right(points, epoch.from_ns - base_ns, key=itemgetter(0)) - 1
        end = bisect_left(points, epoch.to_ns - base_ns, key=itemgetter(0)) + 1
        return tuple((b + base_ns, d - base_ns) for b, d in points[max(first, 0) : end])

    def received_ns(self, run: int, log_ns: int) -> int | None:
        """Return when a log time of a run was; None where nothing is known better.

        Where the clock was set back in between, the newest that fits.
        """
        fitting = [
            e for e in self.journals.values() if e.run == run and e.from_ns <= log_ns <= e.to_ns
        ]
        if not fitting:
            return None
        newest = max(fitting, key=lambda epoch: epoch.from_ns - epoch.base_ns)
        return self.boots[newest.boot].wall_ns(log_ns - newest.base_ns)

    def known_now_ns(self, run: int, received_ns: int) -> int:
        """Return when something was that was received then, as far as was known at that time."""
        for epoch in (epoch for epoch in self.journals.values() if epoch.run == run):
            table = ClockTable(epoch.points)
            near_ns = received_ns - epoch.points[0][1]
            log_ns = received_ns - (table.at(near_ns) - near_ns)
            if epoch.from_ns <= log_ns <= epoch.to_ns:
                return self.boots[epoch.boot].wall_ns(log_ns - epoch.base_ns)
        return received_ns

    def boot_of(self, run: int) -> BootClock | None:
        """Return the boot in which a run took place, if that is known."""
        return next((boot for boot in self.boots.values() if run in boot.runs), None)

    @property
    def notes(self) -> list[str]:
        """Say which times cannot be put right, and why."""
        found = [
            f"{_listed(boot.runs)}: the clock was never synchronised; times are as it said"
            for boot in self.boots.values()
            if boot.synchronised is False
        ]
        ordered = sorted(self.boots.values(), key=lambda boot: boot.runs)
        for before, after in pairwise(ordered):
            if _end_ns(before) > _start_ns(after) and False in _flags(before, after):
                found.append(
                    f"{_listed(after.runs)} came after {_listed(before.runs)}, "
                    "but by their clocks they began before these ended"
                )
        return found


def book_of(clocks: Iterable[JournalClock]) -> ClockBook:
    """Compile the book of a store from what its journals say."""
    by_boot: dict[str, list[JournalClock]] = {}
    for clock in clocks:
        if clock.base_ns is not None:
            by_boot.setdefault(clock.boot, []).append(clock)
    boots = {boot: _boot_clock(boot, tuple(found)) for boot, found in by_boot.items()}
    journals = {clock.name: _epoch(clock) for found in by_boot.values() for clock in found}
    return ClockBook(boots, journals)


def _epoch(clock: JournalClock) -> Epoch:
    times = [reading.log_ns for reading in clock.readings]
    base_ns = clock.base_ns or 0
    first_ns, last_ns = min(times) - MARGIN_NS, max(times) + MARGIN_NS
    points = tuple((reading.log_ns, reading.offset_ns) for reading in clock.readings)
    return Epoch(clock.boot, clock.run, base_ns, first_ns, last_ns, points)


@lru_cache(maxsize=64)
def _boot_clock(boot: str, clocks: tuple[JournalClock, ...]) -> BootClock:
    rows = sorted({row for clock in clocks for row in _rows(clock)}, key=lambda row: row[:2])
    boot_ns, ahead_ns = np.array([row[:2] for row in rows], np.int64).T
    flags = [row[2] for row in rows]
    sections = _sections(boot_ns, ahead_ns)
    moved, largest = _without_steps(boot_ns, ahead_ns, sections, _anchor(sections, flags))
    wall_ns = np.maximum.accumulate(boot_ns + moved)
    points = list(zip(boot_ns.tolist(), (wall_ns - boot_ns).tolist(), strict=True))
    runs = tuple(sorted({clock.run for clock in clocks}))
    return BootClock(boot, runs, simplified(_even(points)), _known(flags), largest)


def _rows(clock: JournalClock) -> Iterator[tuple[int, int, bool | None]]:
    """Give time since boot, wall clock minus that, and the mark of each reading."""
    base_ns = clock.base_ns or 0
    for reading in clock.readings:
        yield reading.log_ns - base_ns, reading.offset_ns + base_ns, reading.synchronised


def _known(flags: Sequence[bool | None]) -> bool | None:
    if True in flags:
        return True
    return False if False in flags else None


def _sections(boot_ns: IntArray, ahead_ns: IntArray) -> list[slice]:
    """Cut where the wall clock moved by more than it may drift or be turned meanwhile."""
    allowed = STEP_NS + np.diff(boot_ns) * _SLEW
    cuts = (np.flatnonzero(np.abs(np.diff(ahead_ns)) > allowed) + 1).tolist()
    edges = [0, *cuts, len(boot_ns)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _anchor(sections: Sequence[slice], flags: Sequence[bool | None]) -> int:
    """Choose the newest section that was synchronised, else the newest."""
    known = [n for n, section in enumerate(sections) if True in flags[section]]
    return known[-1] if known else len(sections) - 1


def _without_steps(
    boot_ns: IntArray, ahead_ns: IntArray, sections: Sequence[slice], anchor: int
) -> tuple[IntArray, int]:
    """Move all sections but one so that each goes on where its neighbour ends."""
    steps = [
        int(ahead_ns[after.start])
        - _continued(boot_ns, ahead_ns, before, int(boot_ns[after.start]))
        for before, after in pairwise(sections)
    ]
    moved = ahead_ns.copy()
    for number, section in enumerate(sections):
        later, earlier = steps[number:anchor], steps[anchor:number]
        moved[section] += sum(later) - sum(earlier)
    return moved, max(map(abs, steps), default=0)


def _continued(boot_ns: IntArray, ahead_ns: IntArray, section: slice, at_ns: int) -> int:
    """Tell what a section would have come to a little later, at the rate it had at its end."""
    times, values = boot_ns[section], ahead_ns[section]
    first = int(np.searchsorted(times, times[-1] - _RATE_SPAN_NS, "right")) - 1
    if first < 0:
        return int(values[-1])
    rate = (int(values[-1]) - int(values[first])) / (int(times[-1]) - int(times[first]))
    rate = min(max(rate, -_SLEW), _SLEW)
    return int(values[-1]) + round((at_ns - int(times[-1])) * rate)


def _even(points: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Put points between those that are far apart, so that no slew is taken for a step."""
    found = list(points[:1])
    for (b0, d0), (b1, d1) in pairwise(points):
        parts = abs(d1 - d0) // (STEP_NS // 2) + 1
        found += [
            (b0 + (b1 - b0) * n // parts, d0 + (d1 - d0) * n // parts) for n in range(1, parts + 1)
        ]
    return found


def _flags(*boots: BootClock) -> list[bool | None]:
    return [boot.synchronised for boot in boots]


def _start_ns(boot: BootClock) -> int:
    return sum(boot.points[0])


def _end_ns(boot: BootClock) -> int:
    return sum(boot.points[-1])


def _listed(runs: Sequence[int]) -> str:
    """Name runs in words; of many in a row only the first and the last."""
    parts: list[list[int]] = []
    for run in sorted(runs):
        if parts and run == parts[-1][-1] + 1:
            parts[-1].append(run)
        else:
            parts.append([run])
    texts = [f"{p[0]} to {p[-1]}" if len(p) > 1 else f"{p[0]}" for p in parts]
    return f"run{'s' * (len(runs) > 1)} {', '.join(texts)}"
