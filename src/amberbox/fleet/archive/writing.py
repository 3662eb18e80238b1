"""Files of a table as they are written: rows of one store and day, journal after journal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amberbox.blackbox.journal.clocktable import ClockPoints
from amberbox.blackbox.segments.build import GROUP_ROWS, bounds_of, median
from amberbox.blackbox.segments.flat import Flat, TableSchema, join
from amberbox.blackbox.segments.manifest import Part
from amberbox.core.clock import NS
from amberbox.core.types import IntArray
from amberbox.fleet.archive.catalogue import Source
from amberbox.fleet.archive.layout import ArchiveFile
from amberbox.fleet.archive.log import LiveFile

_DAY_NS = 24 * 3600 * NS
_RANGES = ("log_time", "received", "timestamp")


@dataclass(frozen=True, slots=True)
class Place:
    """Where rows belong: the file is ``folder/robot=../day=../name`` below the tables."""

    folder: str
    source: Source
    day: str
    name: str

    @property
    def path(self) -> str:
        """The file's path within its table."""
        return f"robot={self.source.robot}/day={self.day}/{self.name}.parquet"


def by_day(flat: Flat) -> Iterator[tuple[str, Flat]]:
    """Cut rows where a day (UTC) ends, by the time of receipt as it is known now."""
    days = flat.received_ns // _DAY_NS
    for number in np.unique(days).tolist():
        rows = np.flatnonzero(days == number)
        day = str(np.datetime64(number, "D"))
        yield day, flat if len(rows) == len(flat) else flat.take(rows)


@dataclass(frozen=True, slots=True)
class Origin:
    """What a part says of the journal that its rows come from."""

    journal: str
    head: str
    clock: ClockPoints


@dataclass
class FileBuilder:
    """Writes one file; ``add`` rows of one journal, then ``end_part``, then the next journal's."""

    tables: Path
    place: Place
    schema: TableSchema
    parts: list[Part] = field(default_factory=list)
    _waiting: list[Flat] = field(default_factory=list)
    _bounds: list[tuple[int, ...]] = field(default_factory=list)
    _ages: list[IntArray] = field(default_factory=list)
    _rows: int = 0
    _ranges: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        path, store_id = f"{self.place.folder}/{self.place.path}", self.place.source.store_id
        self._file = ArchiveFile(self.tables, path, self.schema, store_id)

    def add(self, flat: Flat) -> None:
        """Take rows of the journal that is at hand."""
        self._take(flat)
        self._rows += len(flat)
        self._bounds.append(bounds_of(flat))
        if self.schema.stamp:
            self._ages.append(flat.received_ns - flat.timestamp_ns)

    def add_part(self, flat: Flat, part: Part) -> None:
        """Take over rows with the part that describes them, as another file had it."""
        self._take(flat)
        self.parts.append(part)

    def _take(self, flat: Flat) -> None:
        before = self._waiting[-1] if self._waiting else flat
        if (before.writer, before.run) != (flat.writer, flat.run):
            self._write()
        self._waiting.append(flat)
        self._widen(flat)
        if sum(map(len, self._waiting)) >= GROUP_ROWS:
            self._write()

    def _widen(self, flat: Flat) -> None:
        keys = (flat.log_time_ns, flat.received_ns, flat.timestamp_ns)
        found = [(int(key.min()), int(key.max())) for key in keys]
        known = self._ranges or found
        self._ranges = [
            (min(a[0], b[0]), max(a[1], b[1])) for a, b in zip(known, found, strict=True)
        ]

    def end_part(self, origin: Origin, writer: str, run: int, size: int = 0) -> None:
        """State which journal the rows since the last call are from; ``size`` of its messages."""
        if not self._rows:
            return
        lows = np.min([bound[0::2] for bound in self._bounds], axis=0).tolist()
        highs = np.max([bound[1::2] for bound in self._bounds], axis=0).tolist()
        self.parts.append(
            Part(
                origin.journal, origin.head, writer, run, lows[0], highs[0], self._rows, lows[1],
                highs[1], lows[2], highs[2], 1, size, median(self._ages), origin.clock,
            )
        )  # fmt: skip
        self._bounds, self._ages, self._rows = [], [], 0

    def _write(self) -> None:
        if self._waiting:
            self._file.write(join(self._waiting))
            self._waiting = []

    def finish(self) -> LiveFile:
        """Make the file durable; nobody sees it before it is committed."""
        self._write()
        segment = self._file.finish(self.parts)
        place, writers = self.place, sorted({part.writer for part in self.parts})
        runs = [part.run for part in self.parts]
        low, high = ({n: r[e] for n, r in zip(_RANGES, self._ranges, strict=True)} for e in (0, 1))
        who = {"store_id": place.source.store_id}
        return LiveFile(
            place.path, place.source.robot, place.day, segment.bytes, segment.rows,
            {**low, **who, "writer": writers[0], "run": min(runs)},
            {**high, **who, "writer": writers[-1], "run": max(runs)},
        )  # fmt: skip

    def discard(self) -> None:
        """Leave no temporary file behind after an error."""
        self._file.discard()
