"""Findings of ``verify``: a state, a place, a time range and one plain sentence."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from amberbox.blackbox.journal.scan import ChunkPlace, scan
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import describe
from amberbox.core.timestamps import maybe_time

FindingState = Literal["intact", "damaged", "altered", "missing", "unsigned"]
# Worst first
STATES: tuple[FindingState, ...] = ("altered", "missing", "damaged", "unsigned", "intact")
BAD: frozenset[FindingState] = frozenset({"damaged", "altered", "missing"})


@dataclass(frozen=True, slots=True)
class VerifyFinding:
    """A finding: data changed since the robot wrote them, or not covered by a signature.

    ``chunk`` is the offset of the affected chunk (the first one if there may be several),
    ``from_byte`` and ``to_byte`` bound the affected bytes, ``from_ns`` and ``to_ns`` are their
    times of receipt; None where unknown. ``item`` is set for segments.
    """

    state: FindingState
    file: str
    text: str
    chunk: int | None = None
    from_byte: int | None = None
    to_byte: int | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    item: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the finding as plain data, times as RFC 3339."""
        return {
            "state": self.state,
            "file": self.file,
            "item": self.item or None,
            "chunk": self.chunk,
            "from_byte": self.from_byte,
            "to_byte": self.to_byte,
            "from": maybe_time(self.from_ns),
            "to": maybe_time(self.to_ns),
            "text": self.text,
        }


@dataclass(frozen=True, slots=True)
class HeadHash:
    """A hash to note down: with it one can later prove that nothing before it was changed."""

    what: str
    hash: str
    file: str = ""
    at_ns: int | None = None


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """The findings in a store; ``files`` holds the worst state of each file.

    ``uncovered`` holds why other files in the store are not covered, and the consequence.
    """

    findings: Sequence[VerifyFinding]
    files: Mapping[str, FindingState]
    heads: Sequence[HeadHash] = ()
    notes: Sequence[str] = ()
    bytes: int = 0
    signed: bool = False
    uncovered: Mapping[str, str] = field(default_factory=dict)

    def is_good(self, *, strict: bool = False) -> bool:
        """Return whether all data are unchanged; with ``strict`` an unsigned end is a fault."""
        states = {finding.state for finding in self.findings}
        return not states & BAD and not (strict and "unsigned" in states)


@dataclass(slots=True)
class FindingCollector:
    """Collects findings and checked files."""

    findings: list[VerifyFinding] = field(default_factory=list)
    files: dict[str, FindingState] = field(default_factory=dict)

    def take(self, file: str, findings: Sequence[VerifyFinding]) -> None:
        """Add a checked file with its findings."""
        states = {finding.state for finding in findings}
        known = self.files.get(file, "intact")
        self.files[file] = worst(states | {known})
        self.findings += findings

    def add(self, findings: Iterable[VerifyFinding]) -> None:
        """Add findings, each under the file that it names."""
        for finding in findings:
            self.take(finding.file, [finding])


def worst(states: set[FindingState]) -> FindingState:
    """Return the worst of some states; intact when there is none."""
    return next((state for state in STATES if state in states), "intact")


# Errors that reading a tampered file may raise
READ_ERRORS = (ValueError, KeyError, IndexError, TypeError, struct.error, OSError, OverflowError)


@dataclass
class ChunkLocator:
    """The chunks of a file, looked up when there is a finding about it."""

    path: Path
    name: str
    _chunks: Sequence[ChunkPlace] | None = None
    _clock: ClockTable = field(default_factory=ClockTable)

    def finding(
        self, state: FindingState, text: str, from_byte: int, to_byte: int, chunk: int | None = None
    ) -> VerifyFinding:
        """Return a finding about some bytes: the chunk that is hit first, and a time range."""
        if chunk is None:
            chunk = next((place.offset for place in self._inside(from_byte, to_byte)), None)
        from_ns, to_ns = self.times(from_byte, to_byte)
        return VerifyFinding(state, self.name, text, chunk, from_byte, to_byte, from_ns, to_ns)

    def times(self, from_byte: int, to_byte: int) -> tuple[int | None, int | None]:
        """Return when the chunks in a range were received, else when those around it were."""
        inside = self._inside(from_byte, to_byte)
        if inside:
            return self._received(min(p.start_ns for p in inside), max(p.end_ns for p in inside))
        before = [p.end_ns for p in self.chunks() if p.offset < from_byte]
        after = [p.start_ns for p in self.chunks() if p.offset >= to_byte]
        return self._received(before[-1] if before else None, after[0] if after else None)

    def end_ns(self, to_byte: int | None = None) -> int | None:
        """Return when the last chunk before a place was received."""
        ends = [p.end_ns for p in self.chunks() if to_byte is None or p.offset < to_byte]
        return self._received(ends[-1] if ends else None, None)[0]

    def start_ns(self) -> int | None:
        """Return when the first chunk was received."""
        starts = [place.start_ns for place in self.chunks()]
        return self._received(starts[0] if starts else None, None)[0]

    def chunks(self) -> Sequence[ChunkPlace]:
        """Return the places of the chunks, in the order of the file."""
        if self._chunks is None:
            self._chunks = self._look()
        return self._chunks

    def _look(self) -> Sequence[ChunkPlace]:
        try:
            journal = describe(scan(self.path), self.name)
        except READ_ERRORS:
            return ()
        self._clock = ClockTable(journal.clock)
        return sorted(journal.places, key=lambda place: place.offset)

    def _inside(self, from_byte: int, to_byte: int) -> list[ChunkPlace]:
        return [place for place in self.chunks() if from_byte <= place.offset < to_byte]

    def _received(self, from_ns: int | None, to_ns: int | None) -> tuple[int | None, int | None]:
        known = [t for t in (from_ns, to_ns) if t is not None]
        corrected = iter(self._clock.received(np.array(known, np.int64)).tolist())
        return (
            None if from_ns is None else next(corrected),
            None if to_ns is None else next(corrected),
        )
