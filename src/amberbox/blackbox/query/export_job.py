"""One export: the view of the record, its target, progress and report.

A store changes while it is exported: it is read again when its files move. Journal files are cut
into stretches of time small enough to be held in memory.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np

from amberbox.blackbox.columns.flat_tables import TableSchema
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.rows import By
from amberbox.blackbox.store.catalogue import StoreCatalogue, read_catalogue
from amberbox.blackbox.store.clocks import ClockTable
from amberbox.blackbox.store.journal_reader import JournalFile
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.table_reader import DamagedSegmentError, GatheredRows, note_damaged
from amberbox.core.errors import AmberboxError, UsageError


@dataclass
class ExportReport:
    """The result of an export.

    ``counts`` are rows per table or messages per item. ``notes`` are remarks for the reader,
    ``missing`` requested data that could not be exported.
    """

    target: Path | None
    form: str
    counts: dict[str, int] = field(default_factory=dict)
    bytes: int = 0
    notes: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """Return the number of rows or messages altogether."""
        return sum(self.counts.values())

    def note(self, text: str) -> None:
        """Add a note once."""
        if text not in self.notes:
            self.notes.append(text)

    def miss(self, text: str) -> None:
        """Report something that is not in the export, once."""
        if text not in self.missing:
            self.missing.append(text)

    def add(self, name: str, count: int) -> None:
        """Count rows or messages."""
        self.counts[name] = self.counts.get(name, 0) + count

    def lines(self) -> list[str]:
        """Write the report for a person."""
        counts = [f"  {name}: {count}" for name, count in sorted(self.counts.items())]
        missing = [f"  missing: {text}" for text in self.missing]
        return [*counts, *missing, *(f"  note: {text}" for text in self.notes)]

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON has it."""
        return {
            "target": str(self.target) if self.target else None,
            "format": self.form,
            "total": self.total,
            "counts": self.counts,
            "bytes": self.bytes,
            "notes": self.notes,
            "missing": self.missing,
        }


Window: TypeAlias = tuple[int | None, int | None]  # ``[from, to)`` in nanoseconds; None is open
Answer = TypeVar("Answer")
Rows = TypeVar("Rows", bound=Sized)

_ATTEMPTS = 3


class RefreshingCatalogue:
    """The current catalogue of a store. Data lost during the export are added to the report."""

    def __init__(self, store: Path, report: ExportReport) -> None:
        self.store = store
        self.report = report
        self.catalogue = self._look()
        self._damaged: set[str] = set()
        self._failed = 0

    def _look(self) -> StoreCatalogue:
        return replace(read_catalogue(self.store, with_segments=can_build()), lasting=True)

    def moved_on(self) -> None:
        """Record that data were read since the last refresh."""
        self._failed = 0

    def ask(self, question: Callable[[StoreCatalogue], Answer]) -> Answer:
        """Answer from the current catalogue; refresh it when a file is deleted meanwhile."""
        while True:
            try:
                answer = question(self.catalogue)
            except FileNotFoundError:
                self.again()
            else:
                self.moved_on()
                return answer

    def again(self) -> None:
        """Refresh after a file was deleted; raises AmberboxError when that fails repeatedly."""
        self._failed += 1
        if self._failed > _ATTEMPTS:
            raise AmberboxError(
                f"the files of {self.store} changed while they were being read",
                "export again, a shorter range if it is a long one",
            )
        before = self.catalogue
        self.catalogue = self._sound(self._look())
        was, still = ({*c.existing, *c.manifest.journals} for c in (before, self.catalogue))
        for name in sorted(was - still):  # its raw data and columns are both gone now
            self.report.miss(f"{name} was deleted while it was being exported")

    def read_window(
        self, window: Window, read: Callable[[Window], Iterator[tuple[Rows, int, float]]]
    ) -> Iterator[tuple[Rows, float]]:
        """Yield rows of a window and the share that is done; read on where files move or break.

        ``read`` yields rows, up to when all are given with them, and the share that is done.
        """
        while True:
            try:
                for rows, cut_ns, done in read(window):
                    if len(rows):
                        yield rows, done
                    window = cut_ns, window[1]
                    self.moved_on()
                return
            except DamagedSegmentError as damage:
                self.without(damage)
            except FileNotFoundError:
                self.again()

    def without(self, damage: DamagedSegmentError) -> None:
        """Leave out a damaged segment from now on, and report the lost rows."""
        found = GatheredRows()
        note_damaged(found, self.catalogue, damage.segment, str(damage))
        lost = bool(found.gaps)
        for text in found.notes:
            self.report.miss(text) if lost else self.report.note(text)
        self._damaged.add(damage.segment.path)
        self.catalogue = self._sound(self.catalogue)

    def note_damage(self, journal: JournalFile) -> None:
        """Report the unreadable parts of a journal file."""
        for damage in journal.damage:
            size = damage.to_offset - damage.from_offset
            where = f"{journal.name}: {size} bytes at byte {damage.from_offset}"
            self.report.note(f"{where} cannot be read: {damage.reason}")

    def _sound(self, catalogue: StoreCatalogue) -> StoreCatalogue:
        kept = {
            item: tuple(s for s in segments if s.path not in self._damaged)
            for item, segments in catalogue.manifest.segments.items()
        }
        return replace(catalogue, manifest=replace(catalogue.manifest, segments=kept))


@dataclass(frozen=True)
class View:
    """The selection of a record for an export.

    Without ``items`` all items of the robot's buses are exported; with ``with_box`` also the box's
    own records. ``variables`` names the columns per table, as a query does; other tables have those
    chosen in ``black_box.yaml``, or with ``all_variables`` every one. ``received`` adds the columns
    ``received`` and ``seq``. Several ``windows``, such as missions, follow each other in one
    export.
    """

    items: Sequence[str] = ()
    variables: Mapping[str, Sequence[str]] = field(default_factory=dict)
    windows: Sequence[Window] = ((None, None),)
    by: By = "received"
    all_variables: bool = False
    received: bool = False
    with_box: bool = False


def ordered_windows(windows: Sequence[Window]) -> list[Window]:
    """Put windows in order of time; those that overlap or touch become one.

    Raises UsageError for a window that ends before it begins.
    """
    merged: list[Window] = []
    for from_ns, to_ns in sorted(windows, key=lambda w: (w[0] is not None, w[0] or 0)):
        if from_ns is not None and to_ns is not None and from_ns >= to_ns:
            raise UsageError("the range ends before it begins", "exchange --from and --to")
        if merged and _reaches(merged[-1][1], from_ns):
            merged[-1] = merged[-1][0], _later(merged[-1][1], to_ns)
        else:
            merged.append((from_ns, to_ns))
    return merged


def _reaches(end_ns: int | None, from_ns: int | None) -> bool:
    return end_ns is None or from_ns is None or from_ns <= end_ns


def _later(first_ns: int | None, second_ns: int | None) -> int | None:
    return None if first_ns is None or second_ns is None else max(first_ns, second_ns)


def chosen_tables(catalogue: StoreCatalogue, view: View) -> list[TableSchema]:
    """Return the tables of a view, child tables after their items.

    The child tables of an item are included, unless its variables are named. Raises UsageError for
    an unknown item, and if no table is left.
    """
    named = [*dict.fromkeys([*view.items, *view.variables])]
    schemas = {name: catalogue.schema(name) for name in sorted(catalogue.schemas)}
    if not named:
        found = [s for s in schemas.values() if view.with_box or s.source != channels.SOURCE]
    else:
        tops = [catalogue.schema(name) for name in named]
        found = [table for top in tops for table in _with_children(top, schemas, view)]
        boxes = [s for s in schemas.values() if view.with_box and s.source == channels.SOURCE]
        found += [schema for schema in boxes if schema not in found]
    if not found:
        raise UsageError("there is nothing to export", "'amberbox items WHERE' lists what there is")
    return found


def _with_children(
    top: TableSchema, schemas: Mapping[str, TableSchema], view: View
) -> list[TableSchema]:
    if top.parent or top.item in view.variables:
        return [top]
    return [top, *(schema for schema in schemas.values() if schema.parent == top.item)]


def chosen_items(catalogue: StoreCatalogue, view: View) -> frozenset[str] | None:
    """Return the items whose messages are in a view; None for all.

    A child table's messages are those of its item. Raises UsageError for an unknown item, and for
    variables, because messages can only be exported whole.
    """
    if view.variables:
        raise UsageError(
            "messages are exported whole, not single variables",
            "name items only, or choose csv, parquet or mcap-json",
        )
    if view.by != "received":
        raise UsageError("messages are exported by time of receipt", "leave out --by timestamp")
    if not view.items:
        return None
    raw = {stream.item for j in catalogue.journals(skip=()) for stream in j.streams.values()}
    return frozenset(name if name in raw else _item_of(catalogue, name) for name in view.items)


def _item_of(catalogue: StoreCatalogue, name: str) -> str:
    schema = catalogue.schema(name)
    return schema.parent or schema.item


SLICE_BYTES = 8 << 20
SLICE_ROWS = 50_000

Loaded = TypeVar("Loaded")


@dataclass(frozen=True, slots=True, eq=False)
class LazySlice(Generic[Loaded]):
    """A stretch of a record that is read at once; nothing in it is before ``start_ns``."""

    start_ns: int
    load: Callable[[], Loaded]


def journal_slices(journal: JournalFile, span: Window) -> Iterator[tuple[int, int]]:
    """Yield stretches ``[from, to)`` of ``span`` in a file, each of about 8 MB of it."""
    edges = _edges(journal)
    low = edges[0] if span[0] is None else max(span[0], edges[0])
    high = edges[-1] if span[1] is None else min(span[1], edges[-1])
    inside = [low, *(edge for edge in edges if low < edge < high), high]
    for start, stop in pairwise(inside):
        if start < stop:
            yield start, stop


def _edges(journal: JournalFile) -> list[int]:
    if not journal.places:
        return [0, 0]
    clock = ClockTable(journal.clock)
    low, high = clock.bounds()
    begins = clock.received(np.array([place.start_ns for place in journal.places])).tolist()
    edges = [min(place.start_ns for place in journal.places) + low]
    size, rows = 0, 0
    for place, following, begin in zip(
        journal.places, [*journal.places[1:], None], begins, strict=True
    ):
        if (size >= SLICE_BYTES or rows >= SLICE_ROWS) and begin > edges[-1]:
            edges.append(begin)
            size, rows = 0, 0
        end = following.offset if following is not None else journal.bytes
        size += abs(end - place.offset)
        rows += place.count
    return [*edges, max(edges[-1], max(place.end_ns for place in journal.places) + high) + 1]


Progress = Callable[[float], None]
Compression = Literal["none", "bz2", "lz4"]


@dataclass(frozen=True)
class ExportOptions:
    """How a file is written: ``raw_text`` for CSV, ``compression`` for ROS 1 bags."""

    raw_text: bool = False
    compression: Compression = "none"


@dataclass(frozen=True)
class ExportJob:
    """The input of every form of export."""

    current: RefreshingCatalogue
    view: View
    target: Path | None
    report: ExportReport
    progress: Progress
    options: ExportOptions

    @property
    def path(self) -> Path:
        """The target of a form that cannot go to the terminal."""
        assert self.target is not None
        return self.target


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """Yield a path beside the target to write to; it becomes the target when all went well."""
    part = _part_of(target)
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield a folder beside the target to write to; it becomes the target when all went well.

    Raises UsageError when something is at the target already.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UsageError(f"{target} is there already", "choose a folder that does not exist yet")
    part = _part_of(target)
    part.mkdir()
    try:
        yield part
        if target.exists():
            target.rmdir()
        part.replace(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _part_of(target: Path) -> Path:
    """Return a temporary name for the target, unlike that of any other export or user file."""
    return target.with_name(f"{target.name}.{os.getpid()}.part")


def size_of(target: Path) -> int:
    """Return the bytes of a file, or of the files in a folder."""
    files = target.iterdir() if target.is_dir() else [target]
    return sum(file.stat().st_size for file in files)
