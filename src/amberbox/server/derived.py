"""Derived records of robots (statuses, events, diagnoses), merged from archive columns and link
rows without duplicates.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol, TypeAlias

import msgspec
import numpy as np
from sqlalchemy import ColumnElement, Connection, Row, and_, exists, select

from amberbox.blackbox.columns.flat_tables import FlatTable
from amberbox.blackbox.columns.table_text import plain
from amberbox.blackbox.journal import channels
from amberbox.blackbox.store.catalogue import StoreCatalogue
from amberbox.blackbox.store.table_reader import RowRequest, gather
from amberbox.core.errors import AmberboxError
from amberbox.core.names import child_name, identifier
from amberbox.link.frames import LARGEST
from amberbox.monitoring.findings import finding_of
from amberbox.server.archive.catalogue import COMMITTED, RobotStore
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.reader import ArchiveReader
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.link_state import short_boot_id
from amberbox.server.schema import ASIDE, BOOT, JOURNALS, ROW, RUN

# Store, writer, run, number: the identity of a record
RecordKey: TypeAlias = tuple[str, str, int, int]


@dataclass(frozen=True, slots=True)
class DerivedRecord:
    """One record; ``at_ns`` is the robot's time of writing, with its clock offset as known now.

    ``server_ns`` is that time on the server's clock, None where the clocks were never compared.
    ``aside`` is the reason why the record was removed from the robot's record
    (``lost_at_power_cut``), empty otherwise.
    """

    channel: str
    at_ns: int
    log_ns: int
    store_id: str
    writer: str
    run: int
    seq: int
    values: Mapping[str, Any]
    aside: str = ""
    server_ns: int | None = None

    @property
    def place(self) -> RecordKey:
        """The identity of the record: store, writer, run, number."""
        return self.store_id, self.writer, self.run, self.seq

    @property
    def order(self) -> tuple[int, str, int, int]:
        """The sort key of records: time, then identity."""
        return self.at_ns, self.writer, self.run, self.seq

    def ahead(self, offset_ns: int | None) -> DerivedRecord:
        """Return the record with the server's time added, where the clock offset of its boot is
        known.
        """
        return self if offset_ns is None else replace(self, server_ns=self.at_ns + offset_ns)


# Integers of robots have 64 bits, signed or unsigned
_WHOLE = 2**64


def finding(channel: str, values: Mapping[str, Any]) -> Any:
    """Decode a record into its type; None for one that cannot be decoded."""
    try:
        found = finding_of(channel, values)
        plain = msgspec.to_builtins(found)
        return msgspec.convert(plain, type(found)) if fits(plain) else None
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def fits(value: object, name: str = "") -> bool:
    """Return whether all integers of a record fit: times (``..._ns``) into 62 bits, others into 64.

    A time that fits can be shifted by a clock offset, formatted as a date, and stored in a column.
    """
    if isinstance(value, Mapping):
        return all(fits(inner, str(key)) for key, inner in value.items())
    if isinstance(value, list | tuple):
        return all(fits(inner, name) for inner in value)
    if type(value) is not int:
        return True
    return abs(value) <= LARGEST if name.endswith("_ns") else abs(value) < _WHOLE


Span: TypeAlias = tuple[int | None, int | None]
Values: TypeAlias = dict[str, Any]
# Writer, run and number of a message within a store
Key: TypeAlias = tuple[str, int, int]
Shape: TypeAlias = Mapping[str, Mapping[str, Any]]


def from_columns(
    reader: ArchiveReader, source: RobotStore, channel: str, span: Span, limit: int, *, newest: bool
) -> list[DerivedRecord]:
    """Return the first (or newest) records of a channel in ``[from, to)``, in order of time.

    May return more than ``limit`` where several were received at the same instant.
    """
    table = identifier(channel)
    if table not in reader.schemas:
        return []
    catalogue = reader.of(source, table, request=RowRequest(table, (), span))
    span = _by_files(catalogue, table, span, limit, newest=newest)
    span = _by_rows(catalogue, table, span, limit, newest=newest)
    parts = _Parts(reader, source, span)
    shape = _shape(channel)
    found = [
        (flat, row, key, values)
        for flat in parts.flats(table)
        for row, key, values in _rows(flat, shape)
    ]
    parts.fill(table, shape, {key: values for _, _, key, values in found})
    entries = [
        DerivedRecord(
            channel,
            int(flat.received_ns[row]),
            int(flat.log_time_ns[row]),
            source.store_id,
            *key,
            values,
        )
        for flat, row, key, values in found
    ]
    return sorted(entries, key=lambda entry: entry.order)


def _by_files(
    catalogue: StoreCatalogue, table: str, span: Span, limit: int, *, newest: bool
) -> Span:
    """Narrow a time range to files that certainly hold ``limit`` rows."""
    from_ns, to_ns = span
    inside = [
        (low, high, segment.rows)
        for segment in catalogue.segments(table)
        for low, high in [segment.received_range_ns]
        if (from_ns is None or low >= from_ns) and (to_ns is None or high < to_ns)
    ]
    count = 0
    for low, high, rows in sorted(inside, key=lambda s: -s[0] if newest else s[1]):
        count += rows
        if count >= limit:
            return (low, to_ns) if newest else (from_ns, high + 1)
    return span


def _by_rows(
    catalogue: StoreCatalogue, table: str, span: Span, limit: int, *, newest: bool
) -> Span:
    """Narrow a time range to ``limit`` rows, reading only their times."""
    pieces = gather(catalogue, RowRequest(table, (), span)).pieces
    if sum(map(len, pieces)) <= limit:
        return span
    times = np.sort(np.concatenate([piece.received_ns for piece in pieces]))
    if newest:
        return int(times[-limit]), span[1]
    return span[0], int(times[limit - 1]) + 1


class _Parts:
    """The tables of one channel: its messages, and the child tables of their lists."""

    def __init__(self, reader: ArchiveReader, source: RobotStore, span: Span) -> None:
        self._reader = reader
        self._source = source
        self._span = span

    def flats(self, table: str) -> list[FlatTable]:
        """Read all columns of a table within the range."""
        if table not in self._reader.schemas:
            return []
        names = [column.name for column in self._reader.schema(table).columns]
        request = RowRequest(table, names, self._span)
        catalogue = self._reader.of(self._source, table, request=request)
        return gather(catalogue, request).pieces

    def fill(self, table: str, shape: Shape, messages: Mapping[Key, Values]) -> None:
        """Fill the lists of messages from the child tables, recursively."""
        self._fill(table, shape, {(*key, 0): values for key, values in messages.items()}, "")

    def _fill(
        self, table: str, shape: Shape, parents: Mapping[tuple[Any, ...], Values], key: str
    ) -> None:
        for name, inner in _lists(shape):
            below, children = child_name(table, name), {}
            for number, index, parent, values in self._listed(below, inner, key):
                if (*number, parent) in parents:
                    parents[*number, parent][name].append(values)
                    children[*number, index] = values
            self._fill(below, inner, children, "parent_index")

    def _listed(self, table: str, shape: Shape, key: str) -> Iterator[tuple[Key, int, int, Values]]:
        """Yield the entries of lists in order: message, index, index of the parent."""
        found = []
        for flat in self.flats(table):
            index = plain(flat.columns["index"])
            parents = plain(flat.columns[key]) if key else [0] * len(flat)
            found += [(k, index[n], parents[n], values) for n, k, values in _rows(flat, shape)]
        yield from sorted(found, key=lambda entry: entry[:3])


def _rows(flat: FlatTable, shape: Shape) -> Iterator[tuple[int, Key, Values]]:
    """Yield number, key and values of each row; lists of objects are empty at first."""
    by_path = {column.path: column.name for column in flat.schema.columns}
    columns = {n: plain(flat.columns[by_path[n]]) for n in shape if n in by_path}
    lists = {name for name, _ in _lists(shape)}
    for row, seq in enumerate(flat.seq.tolist()):
        values: Values = {
            name: [] if name in lists else columns[name][row]
            for name in shape
            if name in lists or name in columns
        }
        yield row, (flat.writer, flat.run, seq), values


@lru_cache(maxsize=32)
def _shape(channel: str) -> Shape:
    """Return the properties of a channel's messages, as in docs/reference/format.md."""
    document = msgspec.json.decode(channels.schema_of(channel).data)
    found: Shape = document["properties"]
    return found


def _lists(shape: Shape) -> Sequence[tuple[str, Shape]]:
    """Return the properties that are lists of objects, and the properties of these."""
    return [
        (name, what["items"]["properties"])
        for name, what in shape.items()
        if what["type"] == "array" and what["items"]["type"] == "object"
    ]


def from_link(
    connection: Connection, robot: str, channel: str, span: Span, limit: int, *, newest: bool
) -> list[DerivedRecord]:
    """Return rows of the link that are in no committed journal."""
    held = and_(
        JOURNALS.c.robot == ROW.c.robot, JOURNALS.c.store_id == ROW.c.store_id,
        JOURNALS.c.writer == ROW.c.writer, JOURNALS.c.run == ROW.c.run,
        JOURNALS.c.first_seq <= ROW.c.seq, JOURNALS.c.end_seq > ROW.c.seq,
        JOURNALS.c.state == COMMITTED,
    )  # fmt: skip
    wanted = select(ROW).where(*_in(ROW, robot, channel, span), ~exists().where(held))
    order = ROW.c.log_ns.desc() if newest else ROW.c.log_ns
    return _entries(connection.execute(wanted.order_by(order).limit(limit)))


def conflict_records(
    connection: Connection, robot: str, channel: str, span: Span
) -> list[DerivedRecord]:
    """Return rows that the robot no longer has, with the reason."""
    wanted = select(ASIDE).where(*_in(ASIDE, robot, channel, span))
    return _entries(connection.execute(wanted))


def offsets(connection: Connection, robot: str) -> dict[tuple[str, str, int], int]:
    """Return how far the server's clock was ahead (ns), by store, writer and run.

    Runs carry only the beginning of the boot id.
    """
    boots = connection.execute(select(BOOT).where(BOOT.c.robot == robot)).all()
    known = {short_boot_id(boot.boot_id): boot.offset_ns for boot in boots}
    runs = connection.execute(select(RUN).where(RUN.c.robot == robot, RUN.c.boot != ""))
    return {
        (run.store_id, run.writer, run.run): known[run.boot[:8]]
        for run in runs
        if run.boot[:8] in known
    }


def _in(table: Any, robot: str, channel: str, span: Span) -> list[ColumnElement[bool]]:
    from_ns, to_ns = span
    found = [table.c.robot == robot, table.c.channel == channel]
    found += [] if from_ns is None else [table.c.log_ns >= from_ns]
    return found + ([] if to_ns is None else [table.c.log_ns < to_ns])


def _entries(rows: Iterable[Row[Any]]) -> list[DerivedRecord]:
    found = []
    for row in rows:
        try:
            values = msgspec.json.decode(row.data, type=dict[str, Any])
        except msgspec.MsgspecError:
            continue  # stored as received, but not decodable
        if not fits(values):
            continue
        why = getattr(row, "why", "")
        found.append(
            DerivedRecord(
                row.channel,
                row.log_ns,
                row.log_ns,
                row.store_id,
                row.writer,
                row.run,
                row.seq,
                values,
                why,
            )
        )
    return found


# Largest number of records in one answer
MOST = 100_000
_ATTEMPTS = 5


class RecordStores(Protocol):
    """Access to the stored records; implemented by the server's ``Services``."""

    @property
    def database(self) -> ServerDatabase:
        """The server's database."""

    @property
    def archive(self) -> FolderArchive:
        """The archive."""


def derived_records(
    services: RecordStores,
    robot: str,
    channel: str,
    span: Span = (None, None),
    limit: int = 1000,
    *,
    newest: bool = False,
    aside: bool = False,
) -> list[DerivedRecord]:
    """Return the records that a robot wrote on a channel within ``[from, to)``, each once.

    ``channel`` is one of ``blackbox.journal.reserved`` (``reserved.EVENT``); ``values`` is the
    record, as the functions of ``monitoring.messages`` read it. In order of time, at most
    ``limit``: the first ones, or with ``newest`` the last. With ``aside`` records that were set
    aside are included.
    """
    limit = min(limit, MOST)
    # the link first: rows committed in between are then also found in the archive, not lost
    with services.database.reading() as connection:
        early = from_link(connection, robot, channel, span, limit, newest=newest)
        lost = conflict_records(connection, robot, channel, span) if aside else []
        ahead = offsets(connection, robot)
    late = _from_archive(services.archive, robot, channel, span, limit, newest=newest)
    known = {entry.place for entry in late}
    found = [*late, *(entry for entry in early if entry.place not in known), *lost]
    found.sort(key=lambda entry: entry.order)
    chosen = found[-limit:] if newest else found[:limit]
    return [e.ahead(ahead.get((e.store_id, e.writer, e.run))) for e in chosen]


def _from_archive(
    archive: FolderArchive, robot: str, channel: str, span: Span, limit: int, *, newest: bool
) -> list[DerivedRecord]:
    """Read the records from one snapshot of the tables; retry when files were joined meanwhile."""
    sources = archive.catalogue.sources([robot])
    for _ in range(_ATTEMPTS):
        reader = ArchiveReader(archive.layout, archive.catalogue, sources)
        try:
            return [
                entry
                for source in sources
                for entry in from_columns(reader, source, channel, span, limit, newest=newest)
            ]
        except FileNotFoundError:
            continue
    raise AmberboxError(f"the archive of {robot} changed while it was being read", "ask again")
