"""Missions as detectors read them: the rows of all items of a record, in order of arrival."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from amberbox.blackbox.columns.arrays import element_type
from amberbox.blackbox.journal.channels import SOURCE
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.retention.missions import RecordedMission
from amberbox.core.clock import NS
from amberbox.core.contracts import MissionRows, Row, Span
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import with_parents
from amberbox.core.types import Batch, Column, ItemSchema, Ragged

_NUMBERS = ("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
_FLOATS = ("float32", "float64")
_MOST_TEXT = 200
MOST_ELEMENTS = 32
"""Longer lists, such as the ranges of a laser scanner, are left out."""
_GLANCE_NS = NS
_READ_NS = 600 * NS
"""So much of a mission is in memory at a time."""
DETECTORS_SOURCE = "detect"
"""Source of the items that detectors write; detectors do not read them."""
Window: TypeAlias = tuple[int | None, int | None]


@dataclass(frozen=True)
class RecordRows:
    """The rows of a range of a record; read anew each time, item by item.

    Of each item the numbers, texts and short lists of numbers are read, elements of these as
    ``variable[3]``; longer lists, child tables, and the stamp itself are left out.
    """

    record: Record
    name: str
    span: Span
    items: tuple[str, ...]
    lists: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """The columns of each item that are short lists."""

    def __iter__(self) -> Iterator[Row]:
        start_ns, end_ns = self.span
        for from_ns in range(start_ns, end_ns, _READ_NS):
            part = from_ns, min(from_ns + _READ_NS, end_ns)
            rows = [_rows(self.record, i, part, self.lists.get(i, ())) for i in self.items]
            yield from heapq.merge(*rows, key=_arrival)


@dataclass(frozen=True)
class PartOfMission:
    """A part of a mission: its rows that arrived in ``span``."""

    mission: MissionRows
    span: Span
    name: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.mission.name)

    def __iter__(self) -> Iterator[Row]:
        start_ns, end_ns = self.span
        return (row for row in self.mission if start_ns <= row.at_ns < end_ns)


@dataclass(frozen=True)
class TeamRows:
    """The rows of several robots side by side, in order of arrival; items are ``ROBOT/ITEM``.

    ``ahead_ns`` is how far the clock of the team is ahead of that of each robot.
    """

    members: Mapping[str, RecordRows]
    span: Span
    ahead_ns: Mapping[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Return the names of the missions of the members."""
        return "+".join(rows.name for rows in self.members.values())

    def __iter__(self) -> Iterator[Row]:
        return heapq.merge(*map(self._rows_of, self.members), key=_arrival)

    def _rows_of(self, member: str) -> Iterator[Row]:
        ahead_ns = self.ahead_ns.get(member, 0)
        for row in self.members[member]:
            at_ns, stamp_ns = row.at_ns + ahead_ns, row.stamp_ns + ahead_ns
            yield row._replace(item=f"{member}/{row.item}", at_ns=at_ns, stamp_ns=stamp_ns)

    def within(self, member: str, rows: RecordRows) -> TeamRows | None:
        """Return the part in which another member has rows, with it; None if there is none."""
        ahead_ns = self.ahead_ns.get(member, 0)
        start_ns = max(self.span[0], rows.span[0] + ahead_ns)
        end_ns = min(self.span[1], rows.span[1] + ahead_ns)
        if start_ns >= end_ns:
            return None
        return team_rows({**self.members, member: rows}, (start_ns, end_ns), self.ahead_ns)


def team_rows(
    members: Mapping[str, RecordRows], span: Span, ahead_ns: Mapping[str, int]
) -> TeamRows:
    """Return the rows of robots in a range of the team's time."""
    cut = {
        name: replace(rows, span=(span[0] - ahead_ns.get(name, 0), span[1] - ahead_ns.get(name, 0)))
        for name, rows in members.items()
    }
    return TeamRows(cut, span, ahead_ns)


@dataclass(frozen=True)
class NominalRecord:
    """A record to learn from; ``name`` is the robot, ``recorded`` its missions."""

    record: Record
    name: str
    recorded: Sequence[RecordedMission]

    @classmethod
    def of(cls, record: Record) -> NominalRecord:
        """Return a record with the missions that it knows."""
        return cls(record, str(record.path.name), record.missions())


def missions_of(
    record: Record, names: Sequence[str] = (), within: Window = (None, None)
) -> list[RecordRows]:
    """Return the missions of a record that ended and did not fail; those of some names or ids.

    ``within`` are times of arrival (ns), of which the end is not included: of missions only what
    lies in it is returned. Where nobody recorded missions, the whole record counts as one. Raises
    UsageError for a name that is not there.
    """
    return missions_of_all([NominalRecord.of(record)], names, within)


def missions_of_all(
    records: Sequence[NominalRecord],
    names: Sequence[str] = (),
    within: Window = (None, None),
    note: Callable[[str], None] = lambda text: None,
) -> list[RecordRows]:
    """Return the missions of several records as ``missions_of``, in order of time.

    Each of ``names`` has to be in one of the records; ``note`` receives which record has nothing.
    """
    good = {at: [*_nominal(one.recorded)] for at, one in enumerate(records)}
    known = {name for missions in good.values() for m in missions for name in (m.id, m.name)}
    for name in names:
        if name not in known:
            hint = f"known: {', '.join(sorted(known)) or 'none'}"
            raise UsageError(f"there is no mission '{name}' that ended well", hint)
    found: list[RecordRows] = []
    for at, one in enumerate(records):
        items = readable_items(one.record)
        wanted = (m for m in good[at] if not names or m.id in names or m.name in names)
        spans = [(m.id, (m.from_ns, m.to_ns)) for m in wanted if m.to_ns is not None]
        if not spans and not names and not any(m.failed for m in one.recorded):
            spans = [(one.name, span) for span in _whole(one.record, items)]
        cut = [(name, _clipped(span, within)) for name, span in spans]
        lists = short_lists(one.record, items) if cut else {}
        rows = [
            RecordRows(one.record, name, span, items, lists)
            for name, span in cut
            if span[0] < span[1]
        ]
        if not rows:
            note(f"{one.name}: there is no mission to learn from")
        found += rows
    return sorted(found, key=lambda mission: mission.span)


def team_missions_of(
    records: Sequence[NominalRecord],
    names: Sequence[str] = (),
    within: Window = (None, None),
    ahead_ns: Mapping[str, int] | None = None,
) -> list[TeamRows]:
    """Return when all robots were on nominal missions at the same time, as missions of a team.

    See ``missions_of_all``; raises AmberboxError if there is no such time.
    """
    found = missions_of_all(records, names, within)
    shared: list[TeamRows] | None = None
    for one in records:
        own = [mission for mission in found if mission.record is one.record]
        if shared is None:
            ahead = dict(ahead_ns or {})
            moved = ahead.get(one.name, 0)
            spans = [(rows.span[0] + moved, rows.span[1] + moved) for rows in own]
            shared = [TeamRows({one.name: r}, s, ahead) for r, s in zip(own, spans, strict=True)]
        else:
            parts = (team.within(one.name, rows) for team in shared for rows in own)
            shared = [part for part in parts if part is not None]
    if not shared:
        raise AmberboxError(
            "the robots were never on nominal missions at the same time", "see their missions"
        )
    return sorted(shared, key=lambda team: team.span)


def _nominal(missions: Iterable[RecordedMission]) -> Iterator[RecordedMission]:
    return (m for m in missions if m.to_ns is not None and not m.failed)


def _clipped(span: Span, within: Window) -> Span:
    """Return what of a span lies within a window; it is empty if nothing does."""
    from_ns, to_ns = within
    start_ns = span[0] if from_ns is None else max(span[0], from_ns)
    return start_ns, span[1] if to_ns is None else min(span[1], to_ns)


def readable_items(record: Record) -> tuple[str, ...]:
    """Return the items that sources have written, without those that only have raw messages."""
    ours = (SOURCE, DETECTORS_SOURCE)
    found = [i.name for i in record.items() if i.source not in ours and i.no_columns is None]
    names = frozenset(found)
    return tuple(n for n in found if not names & ({*with_parents(n)} - {n}))


def short_lists(record: Record, items: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the list columns of items that were short in the first second of each."""
    found: dict[str, tuple[str, ...]] = {}
    for info in record.items():
        lists = _read_columns(record.variables(info.name))[1] if info.name in items else []
        if not lists or not info.rows:
            continue
        table = record.query(info.name, lists, info.first_ns, info.first_ns + _GLANCE_NS)
        short = [name for name in lists if _is_short(table[name])]
        if short:
            found[info.name] = tuple(short)
    return found


def _is_short(column: Any) -> bool:
    return isinstance(column, Ragged) and bool((np.diff(column.offsets) <= MOST_ELEMENTS).all())


def shared_out(missions: Sequence[MissionRows]) -> tuple[list[MissionRows], list[MissionRows]]:
    """Return missions to fit on (60 % of the time) and others to calibrate on.

    A single mission is cut in two.
    """
    if len(missions) < 2:
        cuts = [_cut(mission) for mission in missions]
        return [first for first, _ in cuts], [second for _, second in cuts]
    total_ns = sum(_length(mission) for mission in missions)
    reached_ns, split = 0, 1
    for place, mission in enumerate(missions[:-1], 1):
        reached_ns += _length(mission)
        split = place
        if reached_ns >= 0.6 * total_ns:
            break
    return list(missions[:split]), list(missions[split:])


def _length(mission: MissionRows) -> int:
    start_ns, end_ns = mission.span
    return end_ns - start_ns


def _cut(mission: MissionRows) -> tuple[PartOfMission, PartOfMission]:
    start_ns, end_ns = mission.span
    middle_ns = start_ns + round(0.6 * (end_ns - start_ns))
    first, second = (start_ns, middle_ns), (middle_ns, end_ns)
    return PartOfMission(mission, first), PartOfMission(mission, second)


def _whole(record: Record, items: Sequence[str]) -> Iterable[Span]:
    known = (info for info in record.items() if info.name in items and info.rows)
    spans = [(info.first_ns, info.last_ns) for info in known]
    if spans:
        yield min(first for first, _ in spans), max(last for _, last in spans) + 1


def _arrival(row: Row) -> int:
    return row.at_ns


def _rows(record: Record, item: str, span: Span, lists: Sequence[str]) -> Iterator[Row]:
    numbers, _, texts = _read_columns(record.variables(item))
    names = (*numbers, *lists, *texts)
    table = record.query(item, ["received", *names], *span)
    arrived, stamps = (np.asarray(table[n]).tolist() for n in ("received", "timestamp"))
    columns = {name: table[name] for name in names}
    return _rows_of(item, arrived, stamps, columns, texts)


def rows_of_batch(batch: Batch) -> Iterator[Row]:
    """Yield the rows of a batch at their log times, which no step of the wall clock disturbs.

    Stamps are moved along, so that they are as far behind the arrival as they were.
    """
    numbers, lists, texts = _read_columns(batch.schema)
    at_ns = batch.log_time_ns
    stamps_ns = batch.timestamp_ns + (at_ns - batch.received_ns)
    columns = {n: batch.columns[n] for n in (*numbers, *lists, *texts) if n in batch.columns}
    return _rows_of(batch.item, at_ns.tolist(), stamps_ns.tolist(), columns, texts)


def _read_columns(schema: ItemSchema) -> tuple[list[str], list[str], list[str]]:
    """Return the columns with numbers, lists of numbers, and texts, without the own stamp."""
    columns = [c for c in schema.columns if not _is_stamp(c, schema.stamp)]
    numbers = [c.name for c in columns if c.type in (*_NUMBERS, *_FLOATS)]
    lists = [c.name for c in columns if element_type(c.type) in (*_NUMBERS, *_FLOATS)]
    return numbers, lists, [c.name for c in columns if c.type == "string"]


def _is_stamp(column: Column, stamp: str) -> bool:
    """Return whether a column is the item's own stamp, or a part of it."""
    return bool(stamp) and (column.path == stamp or column.path.startswith(f"{stamp}/"))


def _rows_of(
    item: str,
    arrived: Sequence[int],
    stamps: Sequence[int],
    columns: Mapping[str, Any],
    texts: Sequence[str],
) -> Iterator[Row]:
    lists = {name: column for name, column in columns.items() if isinstance(column, Ragged)}
    elements = [_elements(name, column) for name, column in lists.items()]
    plain = {name: column.tolist() for name, column in columns.items() if name not in lists}
    words = {name: plain.pop(name) for name in texts if name in plain}
    for i, at_ns in enumerate(arrived):
        values = {n: float(c[i]) for n, c in plain.items() if c[i] is not None}
        for column in elements:
            values.update(column(i))
        labels = {n: c[i][:_MOST_TEXT] for n, c in words.items() if isinstance(c[i], str)}
        yield Row(item, at_ns, stamps[i], values, labels)


def _elements(variable: str, column: Ragged) -> Callable[[int], dict[str, float]]:
    """Return a function from a row to the elements of its list, none of one that is too long."""
    starts = column.offsets.tolist()
    names = [f"{variable}[{number}]" for number in range(MOST_ELEMENTS)]

    def of_row(row: int) -> dict[str, float]:
        start, end = starts[row], starts[row + 1]
        if end - start > MOST_ELEMENTS:
            return {}
        numbers = column.values[start:end].tolist()
        return {n: float(v) for n, v in zip(names, numbers, strict=False) if v is not None}

    return of_row
