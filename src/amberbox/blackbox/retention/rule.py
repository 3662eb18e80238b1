"""The one rule of deletion: a pure function from the units of a store to removals.

For room: (1) units that a server has confirmed, oldest first; (2) unconfirmed data of the ring; (3)
of class bulk; (4) all other unconfirmed data, oldest first, but never the newest ``keep_min_s``;
(5) columns of units that have to stay, where the journal holds the same rows; (6) confirmed
incidents. Never pinned windows, and never events and statuses: their tables are no part of a unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.store.manifest_entries import DeletionKind
from amberbox.core.clock import NS

ROOM = "for room"
TOO_OLD = "older than its lifetime"


@dataclass(frozen=True, slots=True)
class DeletionUnit:
    """A unit of deletion: a finished journal file, and its columns.

    Bytes are 0 for a part that does not exist (any more). ``age_s`` is the duration of the record
    after its end; ``pending``: its columns are still to be built.
    """

    name: str
    writer: str
    run: int
    start_ns: int
    end_ns: int
    age_s: float
    raw_bytes: int
    column_bytes: int = 0
    confirmed: bool = False
    pending: bool = False


@dataclass(frozen=True, slots=True)
class Removal:
    """One unit or a part of it to delete, and the reason."""

    unit: DeletionUnit
    what: DeletionKind
    reason: str

    @property
    def freed_bytes(self) -> int:
        """Return about how many bytes become free; shared segments stay for a while."""
        raw = self.unit.raw_bytes if self.what != "columns" else 0
        return raw + (self.unit.column_bytes if self.what != "raw" else 0)


def too_old(units: Iterable[DeletionUnit], options: RetentionOptions) -> list[Removal]:
    """Return the units that have outlived their lifetime, oldest first; the ring has its own."""
    raw_s, columns_s = _lifetimes(options)
    found = []
    for unit in by_age(u for u in units if u.writer != "ring"):
        old_raw = unit.age_s > raw_s and unit.raw_bytes > 0
        old_raw &= not (unit.pending and columns_s > raw_s)  # their columns come first
        old_columns = unit.age_s > columns_s and unit.column_bytes > 0
        if old_raw and (old_columns or not unit.column_bytes):
            found.append(Removal(unit, "both", TOO_OLD))
        elif old_raw or old_columns:
            found.append(Removal(unit, "raw" if old_raw else "columns", TOO_OLD))
    return found


def for_room(
    units: Sequence[DeletionUnit], needed_bytes: int, options: RetentionOptions
) -> list[Removal]:
    """Return the removals that free ``needed_bytes``, in the order of the rule.

    Where raw and columns have different lifetimes, the part with the shorter one is deleted first,
    of the whole store. Returns less than is needed when no more may be deleted.
    """
    found, freed = [], 0
    for removal in _in_order(units, options):
        if freed >= needed_bytes:
            break
        found.append(removal)
        freed += removal.freed_bytes
    return found


def spared_columns(units: Iterable[DeletionUnit], needed_bytes: int) -> list[Removal]:
    """Return whose columns go for room while the journals, which hold the same rows, stay.

    For units that have to stay, when nothing else may go.
    """
    found, freed = [], 0
    for unit in by_age(u for u in units if u.raw_bytes and u.column_bytes):
        if freed >= needed_bytes:
            break
        found.append(Removal(unit, "columns", ROOM))
        freed += unit.column_bytes
    return found


def _in_order(units: Sequence[DeletionUnit], options: RetentionOptions) -> Iterator[Removal]:
    candidates = list(_by_the_rule(units, options))
    raw_s, columns_s = _lifetimes(options)
    first: DeletionKind = "raw" if raw_s < columns_s else "columns" if columns_s < raw_s else "both"
    if first == "both":
        yield from (Removal(unit, "both", ROOM) for unit in candidates)
        return
    parted = [unit for unit in candidates if unit.raw_bytes and unit.column_bytes]
    halved = {unit.name for unit in parted}
    yield from (Removal(unit, first, ROOM) for unit in parted)
    for unit in candidates:
        yield Removal(_rest(unit, first) if unit.name in halved else unit, "both", ROOM)


def _rest(unit: DeletionUnit, gone: DeletionKind) -> DeletionUnit:
    return replace(unit, raw_bytes=0) if gone == "raw" else replace(unit, column_bytes=0)


def _by_the_rule(
    units: Sequence[DeletionUnit], options: RetentionOptions
) -> Iterator[DeletionUnit]:
    open_units = [unit for unit in units if not unit.confirmed]
    yield from by_age(unit for unit in units if unit.confirmed)
    yield from by_age(unit for unit in open_units if unit.writer == "ring")
    if options.when_full == "stop":
        return
    yield from by_age(unit for unit in open_units if unit.writer == "bulk")
    others = (unit for unit in open_units if unit.writer not in ("ring", "bulk"))
    yield from by_age(unit for unit in others if unit.age_s >= options.keep_min_s)


def by_age(units: Iterable[DeletionUnit]) -> list[DeletionUnit]:
    """Sort units, the oldest first."""
    return sorted(units, key=lambda unit: (-unit.age_s, unit.name))


def _lifetimes(options: RetentionOptions) -> tuple[float, float]:
    raw_s, columns_s = options.lifetime.raw_s, options.lifetime.columns_s
    return inf if raw_s is None else raw_s, inf if columns_s is None else columns_s


@dataclass(frozen=True, slots=True)
class JournalWindow:
    """The position of a journal file in its writer's run, and its times of receipt.

    ``stepped_ns`` is by how much its clock was set meanwhile; ``synchronised`` whether the clock
    was right at its end, as far as that is known.
    """

    name: str
    writer: str
    run: int
    number: int
    first_seq: int
    end_seq: int
    start_ns: int
    end_ns: int
    chain: str
    stepped_ns: int = 0
    synchronised: bool | None = None


def ages_s(windows: Sequence[JournalWindow], *, sure: bool = False) -> dict[str, float]:
    """Return the duration of the record after the end of each journal, independent of clock steps.

    Files of a run follow each other without a pause: where their times do not, the clock was set.
    Journals of other writers are placed among the main journals of their run. With ``sure`` a pause
    between runs counts only where the clock was synchronised before and after.
    """
    if sure:
        windows = [_by_log_time(window) for window in windows]
    main = _in_turn(w for w in windows if w.writer == "main")
    ages = _chained(main, sure=sure)
    for writer in {w.writer for w in windows} - {"main"}:
        others = _in_turn(w for w in windows if w.writer == writer)
        if not main:
            ages |= _chained(others, sure=sure)
            continue
        for window in others:
            ages[window.name] = _placed(window, main, ages)
    return {name: age_ns / NS for name, age_ns in ages.items()}


def _by_log_time(window: JournalWindow) -> JournalWindow:
    """Return a window without clock steps within its file; the end time stays."""
    if not window.end_ns:
        return window
    return replace(window, start_ns=window.start_ns + window.stepped_ns)


def _in_turn(windows: Iterable[JournalWindow]) -> list[JournalWindow]:
    return sorted((w for w in windows if w.end_ns), key=lambda w: (w.run, w.number))


def _chained(windows: Sequence[JournalWindow], *, sure: bool) -> dict[str, int]:
    ages: dict[str, int] = {}
    age_ns, after = 0, None
    for window in reversed(windows):
        if after is not None:
            pause_ns = after.start_ns - window.end_ns if after.run != window.run else 0
            if sure and not (window.synchronised and after.synchronised):
                pause_ns = 0
            age_ns += max(0, pause_ns) + max(0, after.end_ns - after.start_ns)
        ages[window.name] = age_ns
        after = window
    return ages


def _placed(window: JournalWindow, main: Sequence[JournalWindow], ages: dict[str, int]) -> int:
    """Return the age (s) of a journal by the main journal written when it ended."""
    same = [m for m in main if m.run == window.run]
    for beside in reversed(same):
        if beside.start_ns <= window.end_ns <= beside.end_ns:
            return ages[beside.name] + beside.end_ns - window.end_ns
    if same and window.end_ns > same[-1].end_ns:
        return ages[same[-1].name]
    before = [m for m in main if m.run < window.run]
    oldest = same[0] if same else None
    if oldest is not None:
        return ages[oldest.name] + oldest.end_ns - oldest.start_ns
    return ages[before[-1].name] if before else max(ages.values(), default=0)
