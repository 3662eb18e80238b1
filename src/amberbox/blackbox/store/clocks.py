"""Corrected times of receipt: log time plus the offset of the wall clock as known now.

Within one boot the wall clock minus the time since boot is one continuous function, cut by steps.
The newest section known to be synchronised is right (else the newest); the others are moved so that
there is no step. Nothing is rewritten: readers use the ``ClockBook``. The reasons are in
``docs/develop/notes/004-clock-steps.md``.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amberbox.core.types import IntArray

# Pairs of log time and wall time minus log time, in order of log time; ns
ClockPoints: TypeAlias = tuple[tuple[int, int], ...]

# A larger change of the offset from one point to the next is a step, a smaller one a slew
STEP_NS = 50_000_000

# Points are left out as long as the offset stays this close to the recorded one
TOLERANCE_NS = 500_000

_LONGEST_SLEW_NS = STEP_NS - 10_000_000


class ClockReading(NamedTuple):
    """One record of the clock channel: two clocks and whether the wall clock was synchronised."""

    log_ns: int
    offset_ns: int
    synchronised: bool | None = None
    boot_ns: int | None = None


class OffsetPiece(NamedTuple):
    """From ``log_ns`` on the offset is ``offset_ns`` plus ``rate`` times the time since then."""

    log_ns: int
    offset_ns: int
    rate: float


@dataclass(frozen=True, slots=True)
class ClockTable:
    """Offsets of the wall clock against log time.

    Between two points the offset is linear, at a step it jumps. With ``held`` it is constant until
    the next point: the offset known at the time.
    """

    points: Sequence[tuple[int, int]] = ()
    held: bool = False

    def received(self, log_ns: IntArray) -> IntArray:
        """Return corrected log times, ns; they run backwards at a step only."""
        if not self.points or not any(offset for _, offset in self.points):
            return log_ns
        times, offsets, rates = self._columns()
        place = np.maximum(np.searchsorted(times, log_ns, "right") - 1, 0)
        since = np.maximum(log_ns - times[place], 0)
        corrected: IntArray = (
            log_ns + offsets[place] + np.rint(since * rates[place]).astype(np.int64)
        )
        return corrected

    def at(self, log_ns: int) -> int:
        """Return one corrected log time, ns."""
        return int(self.received(np.array([log_ns], np.int64))[0])

    def span(self, from_ns: int, to_ns: int) -> tuple[int, int]:
        """Return a range of log time with both ends corrected, ns."""
        start, end = self.received(np.array([from_ns, to_ns])).tolist()
        return start, end

    def pieces(self) -> list[OffsetPiece]:
        """Return the stretches over which the offset changes evenly, in order."""
        columns = (column.tolist() for column in self._columns())
        return [OffsetPiece(*piece) for piece in zip(*columns, strict=True)]

    def bounds(self) -> tuple[int, int]:
        """Return the smallest and largest offset of the time of receipt from log time, ns."""
        offsets = [offset for _, offset in self.points] or [0]
        return min(offsets), max(offsets)

    def _columns(self) -> tuple[IntArray, IntArray, NDArray[np.float64]]:
        times, offsets = np.array(self.points or ((0, 0),), np.int64).T
        rates = np.zeros(len(times))
        if not self.held and len(times) > 1:
            lasted, change = np.diff(times), np.diff(offsets)
            even = (np.abs(change) <= STEP_NS) & (lasted > 0)
            rates[:-1][even] = np.maximum(change[even] / lasted[even], -1.0)
        return times, offsets, rates


def held_points(readings: Iterable[ClockReading]) -> ClockPoints:
    """Return the points of the offset as known at any time, for a table with ``held``."""
    points: list[tuple[int, int]] = []
    for reading in readings:
        if not points or points[-1][1] != reading.offset_ns:
            points.append((reading.log_ns, reading.offset_ns))
    return tuple(points)


def simplified(points: Sequence[tuple[int, int]], tolerance_ns: int = TOLERANCE_NS) -> ClockPoints:
    """Return the points without those on the line between others; steps are kept."""
    if len(points) < 3:
        return tuple(points)
    return tuple(points[index] for index in _kept(points, tolerance_ns))


def _kept(points: Sequence[tuple[int, int]], tolerance_ns: int) -> Iterator[int]:
    """Yield the points to keep: every other one is near the line between its neighbours."""
    start = 0
    while start < len(points) - 1:
        yield start
        start = _reach(points, start, tolerance_ns)
    yield start


def _reach(points: Sequence[tuple[int, int]], start: int, tolerance_ns: int) -> int:
    """Return the furthest point that one line from ``start`` can reach within the tolerance.

    It has to be within the cone that the points in between leave open.
    """
    low, high = -np.inf, np.inf
    t0, o0 = points[start]
    for end in range(start + 1, len(points)):
        (before, after), change = (points[end - 1][1], points[end][1]), points[end][1] - o0
        lasted = max(points[end][0] - t0, 1)
        outside = not low <= change / lasted <= high or abs(change) > _LONGEST_SLEW_NS
        if end > start + 1 and (outside or abs(after - before) > STEP_NS):
            return end - 1
        if abs(after - before) > STEP_NS:
            return end
        low = max(low, (change - tolerance_ns) / lasted)
        high = min(high, (change + tolerance_ns) / lasted)
    return len(points) - 1


UNKNOWN_BOOT = "00000000"  # the name of a boot in files of writers that do not know it

MARGIN_NS = 15_000_000_000  # a file may go on for this long after its last reading of the clock

# The kernel turns the wall clock faster or slower by at most this while it follows a reference
_SLEW = 500e-6

_RATE_SPAN_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class JournalClock:
    """The clock readings of one journal file."""

    name: str
    boot: str
    run: int
    readings: tuple[ClockReading, ...]

    @property
    def base_ns(self) -> int | None:
        """Return log time minus time since boot, ns; None where the file does not state it."""
        known = (r.log_ns - r.boot_ns for r in self.readings if r.boot_ns is not None)
        return next(known, None) if self.boot != UNKNOWN_BOOT else None


@dataclass(frozen=True, slots=True)
class BootWallClock:
    """The wall clock of one boot, as far as it is known now.

    ``points`` are (time since boot, wall clock minus that); ``synchronised`` is whether the wall
    clock was ever synchronised, None if unknown.
    """

    boot: str
    runs: tuple[int, ...]
    points: ClockPoints
    synchronised: bool | None

    def wall_ns(self, boot_ns: int) -> int:
        """Return the wall clock at a time since boot."""
        return ClockTable(self.points).at(boot_ns)


@dataclass(frozen=True, slots=True)
class RunEpoch:
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

    boots: Mapping[str, BootWallClock] = field(default_factory=dict)
    journals: Mapping[str, RunEpoch] = field(default_factory=dict)

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

    @property
    def notes(self) -> list[str]:
        """Return which times cannot be corrected, and why."""
        found = [
            f"{_listed(boot.runs)}: the clock was never synchronised; times are as it said"
            for boot in self.boots.values()
            if boot.synchronised is False
        ]
        ordered = sorted(self.boots.values(), key=lambda boot: boot.runs)
        for before, after in pairwise(ordered):
            if sum(before.points[-1]) > sum(after.points[0]) and False in _flags(before, after):
                found.append(
                    f"{_listed(after.runs)} came after {_listed(before.runs)}, "
                    "but by their clocks they began before these ended"
                )
        return found


def book_of(clocks: Iterable[JournalClock]) -> ClockBook:
    """Compile the book of a store from the clock readings of its journals."""
    by_boot: dict[str, list[JournalClock]] = {}
    for clock in clocks:
        if clock.base_ns is not None:
            by_boot.setdefault(clock.boot, []).append(clock)
    boots = {boot: _boot_clock(boot, tuple(found)) for boot, found in by_boot.items()}
    journals = {clock.name: _epoch(clock) for found in by_boot.values() for clock in found}
    return ClockBook(boots, journals)


def _epoch(clock: JournalClock) -> RunEpoch:
    times = [reading.log_ns for reading in clock.readings]
    base_ns = clock.base_ns or 0
    first_ns, last_ns = min(times) - MARGIN_NS, max(times) + MARGIN_NS
    points = tuple((reading.log_ns, reading.offset_ns) for reading in clock.readings)
    return RunEpoch(clock.boot, clock.run, base_ns, first_ns, last_ns, points)


@lru_cache(maxsize=64)
def _boot_clock(boot: str, clocks: tuple[JournalClock, ...]) -> BootWallClock:
    rows = sorted({row for clock in clocks for row in _rows(clock)}, key=lambda row: row[:2])
    boot_ns, ahead_ns = np.array([row[:2] for row in rows], np.int64).T
    flags = [row[2] for row in rows]
    # Cut where the wall clock moved by more than it may drift or be turned meanwhile.
    allowed = STEP_NS + np.diff(boot_ns) * _SLEW
    cuts = (np.flatnonzero(np.abs(np.diff(ahead_ns)) > allowed) + 1).tolist()
    edges = [0, *cuts, len(boot_ns)]
    sections = [slice(a, b) for a, b in pairwise(edges)]
    moved = _without_steps(boot_ns, ahead_ns, sections, _anchor(sections, flags))
    wall_ns = np.maximum.accumulate(boot_ns + moved)
    points = list(zip(boot_ns.tolist(), (wall_ns - boot_ns).tolist(), strict=True))
    runs = tuple(sorted({clock.run for clock in clocks}))
    return BootWallClock(boot, runs, simplified(_even(points)), _known(flags))


def _rows(clock: JournalClock) -> Iterator[tuple[int, int, bool | None]]:
    """Yield time since boot, wall clock minus that, and the mark of each reading."""
    base_ns = clock.base_ns or 0
    for reading in clock.readings:
        yield reading.log_ns - base_ns, reading.offset_ns + base_ns, reading.synchronised


def _known(flags: Sequence[bool | None]) -> bool | None:
    if True in flags:
        return True
    return False if False in flags else None


def _anchor(sections: Sequence[slice], flags: Sequence[bool | None]) -> int:
    """Return the newest section that was synchronised, else the newest."""
    known = [n for n, section in enumerate(sections) if True in flags[section]]
    return known[-1] if known else len(sections) - 1


def _without_steps(
    boot_ns: IntArray, ahead_ns: IntArray, sections: Sequence[slice], anchor: int
) -> IntArray:
    """Return offsets with all sections but one moved so that each continues its neighbour."""
    steps = [
        int(ahead_ns[after.start])
        - _continued(boot_ns, ahead_ns, before, int(boot_ns[after.start]))
        for before, after in pairwise(sections)
    ]
    moved = ahead_ns.copy()
    for number, section in enumerate(sections):
        later, earlier = steps[number:anchor], steps[anchor:number]
        moved[section] += sum(later) - sum(earlier)
    return moved


def _continued(boot_ns: IntArray, ahead_ns: IntArray, section: slice, at_ns: int) -> int:
    """Return a section extrapolated to a time, at its rate at its end."""
    times, values = boot_ns[section], ahead_ns[section]
    first = int(np.searchsorted(times, times[-1] - _RATE_SPAN_NS, "right")) - 1
    if first < 0:
        return int(values[-1])
    rate = (int(values[-1]) - int(values[first])) / (int(times[-1]) - int(times[first]))
    rate = min(max(rate, -_SLEW), _SLEW)
    return int(values[-1]) + round((at_ns - int(times[-1])) * rate)


def _even(points: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Insert points between those that are far apart, so that no slew is mistaken for a step."""
    found = list(points[:1])
    for (b0, d0), (b1, d1) in pairwise(points):
        parts = abs(d1 - d0) // (STEP_NS // 2) + 1
        found += [
            (b0 + (b1 - b0) * n // parts, d0 + (d1 - d0) * n // parts) for n in range(1, parts + 1)
        ]
    return found


def _flags(*boots: BootWallClock) -> list[bool | None]:
    return [boot.synchronised for boot in boots]


def _listed(runs: Sequence[int]) -> str:
    """Return runs as text; of many in a row only the first and the last."""
    parts: list[list[int]] = []
    for run in sorted(runs):
        if parts and run == parts[-1][-1] + 1:
            parts[-1].append(run)
        else:
            parts.append([run])
    texts = [f"{p[0]} to {p[-1]}" if len(p) > 1 else f"{p[0]}" for p in parts]
    return f"run{'s' * (len(runs) > 1)} {', '.join(texts)}"
