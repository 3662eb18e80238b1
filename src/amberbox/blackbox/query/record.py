"""Queries of a record: its items, rows of a time range, gaps, missions, events.

``Record`` is the contract; a store on this computer (``LocalRecord``), a server's archive and a
server's API satisfy it.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from amberbox.blackbox.columns.flat_tables import FlatTable, flatten
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query import gaps as gap_list
from amberbox.blackbox.query.overview import ItemInfo, overview
from amberbox.blackbox.query.rows import (
    By,
    make_table,
    needed_columns,
    query_missions,
    query_tables,
    wanted_columns,
)
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.query.transforms import Transform, find_transform
from amberbox.blackbox.store.catalogue import (
    Answer,
    StoreCatalogue,
    query_catalogue,
    read_catalogue,
)
from amberbox.blackbox.store.clocks import ClockBook
from amberbox.blackbox.store.incident import LogSpan, StoredIncident, incident_named
from amberbox.blackbox.store.manifest import notes as damage_notes
from amberbox.blackbox.store.segment_file import can_build
from amberbox.blackbox.store.store import FOLDERS, is_store, open_store, store_path
from amberbox.blackbox.store.table_reader import merge
from amberbox.blackbox.store.tail import follow
from amberbox.core.clock import NS
from amberbox.core.names import identifier
from amberbox.core.notes import KIND as NOTE_KIND
from amberbox.core.notes import RecordedNote, in_range, newest_notes, note_of
from amberbox.core.timestamps import ordered_span, parse_time
from amberbox.core.types import Batch, Column, Gap, ItemSchema

if TYPE_CHECKING:
    from amberbox.blackbox.retention.missions import RecordedMission

Time = int | str | None


class Record(Protocol):
    """The record of a robot; a query of a live record includes its newest rows.

    Times are nanoseconds since the Unix epoch or texts (ISO, epoch, ``-10m``, ``now``); ranges are
    ``[from_, to)``. Methods raise UsageError for unknown items, variables and times. ``path`` is
    the folder that holds the record, or its name on a server; ``notes`` name its unreadable parts.
    """

    path: Path
    notes: tuple[str, ...]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the record and free its resources."""
        return

    def items(self) -> list[ItemInfo]:
        """Return each recorded data item and child table with rows, rates, times."""

    def has_item(self, item: str) -> bool:
        """Return whether an item has columns."""

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item: the union over all versions of its schema."""

    def query(
        self,
        item: str,
        variables: Sequence[str] | None = None,
        from_: Time = None,
        to: Time = None,
        by: By = "received",
        points: int | None = None,
        *,
        missions: Sequence[RecordedMission] | None = None,
    ) -> Table:
        """Return ``timestamp`` and variables of an item, in order of time.

        Without ``variables`` the table has the ones chosen in ``black_box.yaml``, else all;
        ``received`` and ``seq`` are included when named. ``points`` reduces the rows, keeping
        extremes. With ``missions`` their ranges are returned; for several, a column ``mission``
        holds the id.
        """

    def time_ns(self, moment: Time) -> int | None:
        """Read a time as ``query`` does; ``-10m`` counts from the last record."""
        if not isinstance(moment, str):
            return moment
        return parse_time(moment, time.time_ns, self.last_ns)

    def span_ns(self, from_: Time, to: Time) -> tuple[int | None, int | None]:
        """Read both ends of a range; raises UsageError if it ends before it begins."""
        return ordered_span(self.time_ns(from_), self.time_ns(to))

    def last_ns(self) -> int | None:
        """Return when the last record was received; None where there is none."""

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return the gaps with their reasons, of one item or of all."""

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[RecordedMission]:
        """Return missions in order of their start: of a name, failed ones, the last few."""

    def drawn(
        self, item: str, variables: Sequence[str], span: tuple[Time, Time], by: By, points: int
    ) -> tuple[Table, bool]:
        """Return the rows for a plot of ``points`` points, and whether these are all rows."""
        return self.query(item, variables, *span, by), True

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """Return the ranges of an incident (its id, or ``last``), in order."""

    def clock(self) -> ClockBook:
        """Return the known clock offsets of each boot, and the boots that cannot be corrected."""

    def sql(self, statement: str) -> Table:
        """Run a SELECT: each item and child table is a view (see ``blackbox.query.sql``)."""

    def transform(self, target: str, source: str, at: Time = None) -> Transform:
        """Return the transform of points in the frame ``source`` to points in ``target``.

        ``at`` is a time of the stamps of transforms, None for the newest that is known. Raises
        UsageError for unknown frames, frames that are not connected, and times without transforms.
        """
        return find_transform(self, target, source, self.time_ns(at))

    def events(self, from_: Time = None, to: Time = None) -> Table:
        """Return the events of the box: its event channel as a table."""
        return event_table(self, *self.span_ns(from_, to))

    def annotations(self, from_: Time = None, to: Time = None) -> list[RecordedNote]:
        """Return the notes of people that meet a range, in order of their times.

        Those that are withdrawn are left out.
        """
        from_ns, to_ns = self.span_ns(from_, to)
        events = self.events()
        rows = events.rows() if "details" in events.names else ()
        found = (note_of(row) for row in rows if row["kind"] == NOTE_KIND)
        return in_range(newest_notes(n for n in found if n is not None).values(), from_ns, to_ns)


def event_table(record: Record, from_: Time, to: Time) -> Table:
    """Return the rows of a record's event channel; an empty table where it has none."""
    name = identifier(channels.EVENT)
    if record.has_item(name):
        return record.query(name, None, from_, to)
    stamp = Column("timestamp", "timestamp", "time")
    return Table("events", (stamp,), {"timestamp": np.empty(0, np.int64)})


@dataclass(frozen=True)
class LocalRecord(Record):
    """The record in a store on this computer.

    ``temporary`` holds the store that recording files were imported into; it is deleted with this
    object, or by ``close``. Without pyarrow the journals are read instead of the segments: slower,
    with the same result.
    """

    path: Path
    temporary: tempfile.TemporaryDirectory[str] | None = None
    notes: tuple[str, ...] = ()

    def close(self) -> None:
        """Remove the temporary store, if there is one."""
        if self.temporary is not None:
            self.temporary.cleanup()

    def items(self) -> list[ItemInfo]:
        """See ``Record``."""
        return self._with_catalogue(overview)

    def has_item(self, item: str) -> bool:
        """See ``Record``."""
        return self._with_catalogue(lambda catalogue: item in catalogue.schemas)

    def variables(self, item: str) -> ItemSchema:
        """See ``Record``."""
        schema = self._with_catalogue(lambda catalogue: catalogue.schema(item))
        return ItemSchema(schema.type, schema.columns, {}, schema.stamp)

    def query(
        self,
        item: str,
        variables: Sequence[str] | None = None,
        from_: Time = None,
        to: Time = None,
        by: By = "received",
        points: int | None = None,
        *,
        missions: Sequence[RecordedMission] | None = None,
    ) -> Table:
        """See ``Record``."""
        if missions is not None:
            return query_missions(
                missions, lambda start, end: self.query(item, variables, start, end, by, points)
            )
        span = self.span_ns(from_, to)
        return self._with_catalogue(lambda c: query_tables(c, item, variables, span, by, points))

    def last_ns(self) -> int | None:
        """See ``Record``."""
        return self._with_catalogue(gap_list.last_received_ns)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """See ``Record``."""
        span = self.span_ns(from_, to)
        return self._with_catalogue(lambda catalogue: gap_list.gaps(catalogue, item, span))

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[RecordedMission]:
        """See ``Record``."""
        from amberbox.blackbox.retention.missions import choose, load

        return choose(load(self.path), name, failed=failed, last=last)

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """See ``Record``."""
        return windows_of(self.path, incident_named(open_store(self.path), incident))

    def clock(self) -> ClockBook:
        """See ``Record``."""
        return self._with_catalogue(lambda catalogue: catalogue.book)

    def sql(self, statement: str) -> Table:
        """See ``Record``."""
        from amberbox.blackbox.query.sql import run_sql

        return self._with_catalogue(lambda catalogue: run_sql(catalogue, statement))

    def _with_catalogue(self, question: Callable[[StoreCatalogue], Answer]) -> Answer:
        return query_catalogue(self.path, question, with_segments=can_build())


def open(where: str | Path) -> LocalRecord:
    """Open a robot folder, a store, or a recording (bag, MCAP, ULog, CSV, mongodump), for reading.

    Raises UsageError when ``where`` is none of these.
    """
    path = Path(where)
    if _is_recording(path):
        return _import(path)
    store = store_path(path)
    return LocalRecord(store, notes=tuple(damage_notes(store)))


def _is_recording(path: Path) -> bool:
    if is_store(path) or (path / "robot.yaml").exists() or (path / "black_box.yaml").exists():
        return False
    bag, dump = path / "metadata.yaml", path.glob("*.bson*")
    return path.is_file() or bag.is_file() or next(dump, None) is not None


def _import(path: Path) -> LocalRecord:
    from amberbox.blackbox.query.importing import import_recordings

    folder = tempfile.TemporaryDirectory(prefix="amberbox-")
    store = Path(folder.name) / "store"
    (report,) = import_recordings([path], store)
    notes = (*(f"damaged: {text}" for text in report.damage), *report.notes)
    return LocalRecord(store, folder, notes)


_CLOSE_NS = 60 * NS


def windows_of(store: Path, incident: StoredIncident) -> list[tuple[int, int]]:
    """Return the ranges ``[from, to)`` of an incident, in order.

    There are several if its clock was set within the window by an unknown amount.
    """
    book = read_catalogue(store, with_segments=can_build()).book
    found = sorted(_received(span, book) for span in incident.spans)
    if incident.state == "open":  # more is to come
        found[-1] = (found[-1][0], max(found[-1][1], incident.to_ns))
    joined = found[:1]
    for start, end in found[1:]:
        if start - joined[-1][1] <= _CLOSE_NS:
            joined[-1] = (joined[-1][0], max(joined[-1][1], end))
        else:
            joined.append((start, end))
    return joined


def _received(span: LogSpan, book: ClockBook) -> tuple[int, int]:
    known = [book.received_ns(span.run, log_ns) for log_ns in (span.from_ns, span.to_ns)]
    if known[0] is None or known[1] is None:
        return span.received()
    return known[0], known[1] + 1


_NOW_S = 1e-3


def follow_tables(
    record: Record,
    item: str,
    variables: Sequence[str] | None = None,
    from_: Time = None,
    *,
    live: bool = True,
    stop: threading.Event | None = None,
) -> Iterator[Table]:
    """Yield rows of an item as they are written, from ``from_`` on, or from the newest one.

    Raises UsageError for an unknown item or variable.
    """
    catalogue = read_catalogue(record.path, with_segments=can_build())
    schema = catalogue.schema(item)
    wanted = wanted_columns(catalogue, schema, variables)
    needed = needed_columns(wanted)
    from_ns, last_ns = record.time_ns(from_), record.last_ns()
    lookback_s = _NOW_S
    if from_ns is not None and last_ns is not None:
        lookback_s = max((last_ns - from_ns) / NS, 0.0) + _NOW_S
    top = schema.parent or schema.item
    deliveries = follow(
        record.path, {top}, lookback_s=lookback_s, live=live, stop=stop, writers=tuple(FOLDERS)
    )
    for delivery in deliveries:
        if isinstance(delivery, Batch):
            for rows in _rows(delivery, schema.item, from_ns):
                yield make_table(schema, wanted, merge([rows], schema, needed, "received"))


def _rows(batch: Batch, table: str, from_ns: int | None) -> Iterator[FlatTable]:
    for flat in flatten(batch):
        if flat.schema.item == table:
            rows = flat if from_ns is None else flat.take(flat.received_ns >= from_ns)
            if len(rows):
                yield rows
