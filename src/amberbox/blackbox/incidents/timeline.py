"""The record's own time: how long ago something was, however often the clock was set meanwhile.

Within a run without a step of the clock, log time tells. From one such stretch to the next it is
the time since boot that tells, where the files state it and the computer was not started anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.incidents.extent import Extent, extent
from amberbox.blackbox.incidents.incident import At, Span
from amberbox.blackbox.store import Store
from amberbox.core.clock import NS

_PAUSE_NS = 2 * NS
"""Without news a recorder writes once a second: files of a run that lie further apart do so
because the clock was set."""
_MARGIN_NS = NS
"""Other journals may have rows just before the main one's first and after its last."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of a run without a step of the clock, and where it lies in the record's time.

    ``age_ns`` is how long before the end of the record it ended.
    """

    run: int
    start_ns: int
    end_ns: int
    age_ns: int
    offset_ns: int
    first: Extent

    def age_of(self, log_ns: int) -> int:
        """Tell how long before the end of the record a log time was."""
        return self.age_ns + self.end_ns - log_ns

    @property
    def start_age_ns(self) -> int:
        """How long before the end of the record it began."""
        return self.age_of(self.start_ns)


@dataclass(frozen=True, slots=True)
class Timeline:
    """The newest stretches of a record, newest first."""

    pieces: tuple[Piece, ...]

    @property
    def end(self) -> At:
        """The last moment of the record."""
        return At(self.pieces[0].run, self.pieces[0].end_ns)

    @property
    def end_received_ns(self) -> int:
        """The last moment as time of receipt."""
        return self.pieces[0].end_ns + self.pieces[0].offset_ns

    def age_ns(self, at: At) -> int | None:
        """Tell how long before the end a moment was; None where it lies before all pieces."""
        for piece in self.pieces:
            if piece.run == at.run and piece.start_ns - _MARGIN_NS <= at.log_ns:
                return max(piece.age_of(at.log_ns), 0)
            if piece.run < at.run:
                return max(piece.age_ns, 0)
        return None

    def at(self, age_ns: int) -> At:
        """Return the moment that was so long before the end, or the oldest one there is."""
        for piece in self.pieces:
            if age_ns <= piece.start_age_ns:
                return At(piece.run, min(piece.end_ns - (age_ns - piece.age_ns), piece.end_ns))
        return At(self.pieces[-1].run, self.pieces[-1].start_ns)

    def received_ns(self, at: At) -> int:
        """Return a moment as time of receipt."""
        for piece in self.pieces:
            if piece.run == at.run and piece.start_ns - _MARGIN_NS <= at.log_ns:
                return at.log_ns + piece.offset_ns
        return at.log_ns

    def spans(self, oldest_age_ns: int, newest_age_ns: int) -> tuple[Span, ...]:
        """Return what lies between two ages, oldest first; stretches that end inside as a whole."""
        found = []
        for piece in self.pieces:
            if piece.age_ns <= oldest_age_ns and piece.start_age_ns >= newest_age_ns:
                found.append(_cut(piece, oldest_age_ns, newest_age_ns))
        return tuple(reversed(found))


def _cut(piece: Piece, oldest_age_ns: int, newest_age_ns: int) -> Span:
    from_ns = piece.end_ns - (oldest_age_ns - piece.age_ns)
    to_ns = piece.end_ns - (newest_age_ns - piece.age_ns)
    if from_ns < piece.start_ns:
        from_ns = piece.start_ns - _MARGIN_NS
    if to_ns > piece.end_ns:
        to_ns = piece.end_ns + _MARGIN_NS
    return Span(piece.run, from_ns, to_ns, piece.offset_ns)


def look_back(store: Store, back_ns: int, at: At | None = None) -> Timeline | None:
    """Look at the record from its end to ``back_ns`` before a moment; None if it is empty."""
    extents: list[Extent] = []
    for found in _newest_first(store.journal_files("main")):
        extents.append(found)
        timeline = Timeline(_pieces(extents))
        if _reaches(timeline, back_ns, at):
            return timeline
    return Timeline(_pieces(extents)) if extents else None


def _newest_first(paths: Sequence[Path]) -> Iterator[Extent]:
    return (found for found in map(extent, reversed(paths)) if found is not None)


def _reaches(timeline: Timeline, back_ns: int, at: At | None) -> bool:
    age_ns = 0 if at is None else timeline.age_ns(at)
    return age_ns is not None and timeline.pieces[-1].start_age_ns >= age_ns + back_ns


def _pieces(newest_first: Sequence[Extent]) -> tuple[Piece, ...]:
    """Join files that follow each other on one clock."""
    pieces: list[Piece] = []
    for found in newest_first:
        after = pieces[-1] if pieces else None
        if after is not None and _goes_on(found, after.first):
            pieces[-1] = Piece(
                found.run, found.start_ns, after.end_ns, after.age_ns, found.offset_ns, found
            )
            continue
        age_ns = 0 if after is None else after.start_age_ns + _pause_ns(found, after.first)
        pieces.append(
            Piece(found.run, found.start_ns, found.end_ns, age_ns, found.offset_ns, found)
        )
    return tuple(pieces)


def _goes_on(before: Extent, after: Extent) -> bool:
    same_base = None in (before.boot_base_ns, after.boot_base_ns) or (
        before.boot_base_ns == after.boot_base_ns
    )
    apart_ns = after.start_ns - before.end_ns
    return before.run == after.run and same_base and -NS <= apart_ns <= _PAUSE_NS


def _pause_ns(before: Extent, after: Extent) -> int:
    """Tell how long the record paused between two stretches; never below 0."""
    if before.boot_base_ns is not None and after.boot_base_ns is not None and _same_boot(
        before, after
    ):  # fmt: skip
        began_ns, ended_ns = (
            after.start_ns - after.boot_base_ns,
            before.end_ns - before.boot_base_ns,
        )
        return max(began_ns - ended_ns, 0)
    return 0 if before.run == after.run else max(after.start_ns - before.end_ns, 0)


def _same_boot(before: Extent, after: Extent) -> bool:
    return bool(before.boot) and before.boot == after.boot
