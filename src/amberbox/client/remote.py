"""The record of a robot on a server, with the interface of a local ``Record``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from amberbox.blackbox.query.overview import ItemInfo
from amberbox.blackbox.query.record import Record, Time, event_table
from amberbox.blackbox.query.rows import By, check_order, query_missions
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.store.clocks import ClockBook
from amberbox.client import table_reader
from amberbox.client.models import maybe_ns, time_ns
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.notes import RecordedNote, in_range
from amberbox.core.types import Gap, ItemSchema

if TYPE_CHECKING:
    from amberbox.blackbox.retention.missions import RecordedMission
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import Item

_SQL_HINT = (
    "amberbox export URL -o robot.mcap, then amberbox sql robot.mcap; on the server itself: "
    "amberbox sql DIR"
)
NOT_YET = "not on the server yet"
"""Reason of a gap whose data are still on the robot."""
DRAWN_ROWS = 200_000
"""Largest number of rows that are drawn unchanged; the server thins out more rows."""


@dataclass(frozen=True)
class RemoteRecord(Record):
    """A robot's record on a server; ``path`` is only its name."""

    path: Path
    fleet: Fleet = field(repr=False)
    robot: str = ""
    notes: tuple[str, ...] = ()

    def close(self) -> None:
        """Close the connection."""
        self.fleet.close()

    def items(self) -> list[ItemInfo]:
        """Return the items that the server has rows of; without stamps and sizes."""
        return [_info(item) for item in self.fleet.items(self.robot)]

    def has_item(self, item: str) -> bool:
        """Return whether the server has rows of an item."""
        return any(one.name == item for one in self.fleet.items(self.robot))

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item."""
        found = self.fleet.item(self.robot, item)
        columns = tuple(table_reader.column_of(one) for one in found.columns)
        return ItemSchema(found.type, columns, {}, found.stamp)

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
        """Return rows as a local record does (see ``Record.query``)."""
        if missions is not None:
            return query_missions(
                missions, lambda start, end: self.query(item, variables, start, end, by, points)
            )
        check_order(by, points)
        pages = [*self.fleet.pages(self.robot, item, variables, from_, to, by, points)]
        if pages[0].kind == "envelope":
            known = {column.name: column for column in self.variables(item).columns}
            return table_reader.as_rows(pages[0].table, known)
        return table_reader.concatenate([page.table for page in pages])

    def drawn(
        self, item: str, variables: Sequence[str], span: tuple[Time, Time], by: By, points: int
    ) -> tuple[Table, bool]:
        """Return rows for a plot, and whether they are all; of a long range they are reduced."""
        pages = self.fleet.pages(self.robot, item, variables, *span, by, None, DRAWN_ROWS)
        first = next(pages)
        if not first.next:
            return first.table, True
        return self.query(item, variables, *span, by, points), False

    def last_ns(self) -> int | None:
        """Return the receive time (ns) of the newest row on the server, None without rows."""
        return max((info.last_ns for info in self.items()), default=None)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return the gaps in ``[from_, to)`` with reasons, including data not copied yet."""
        return [
            Gap(
                g.writer,
                g.run,
                time_ns(g.from_),
                time_ns(g.to),
                g.reason,
                g.item,
                g.count,
                peer=g.publisher,
            )
            for g in self.fleet.gaps(self.robot, item or "", from_, to)
        ]

    def missions(
        self, name: str | None = None, *, failed: bool = False, last: int | None = None
    ) -> list[RecordedMission]:
        """Return missions in order of their start: those of the robot and those of the server."""
        from amberbox.blackbox.retention.missions import MissionInstant, RecordedMission, choose

        found = [
            RecordedMission(
                m.id, m.name, MissionInstant(time_ns(m.from_)),
                None if m.to is None else MissionInstant(time_ns(m.to)),
                m.outcome, m.failed, m.who, m.parameters,
            )
            for m in self.fleet.missions(self.robot)
        ]  # fmt: skip
        found.sort(key=lambda mission: (mission.from_ns, mission.id))
        return choose(found, name, failed=failed, last=last)

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """Return the window (ns) of an incident; ``last`` is the newest one."""
        known = {one.id: one for one in self.fleet.incidents(self.robot)}
        chosen = next(iter(known.values()), None) if incident == "last" else known.get(incident)
        if chosen is None:
            near = did_you_mean(incident, known)
            raise UsageError(f"there is no incident '{incident}'{near}", "amberbox incident list")
        return [(time_ns(chosen.from_), time_ns(chosen.to))]

    def clock(self) -> ClockBook:
        """Return an empty clock book: the server has already corrected the times."""
        return ClockBook()

    def sql(self, statement: str) -> NoReturn:
        """Raise UsageError: a server runs no SQL of its clients."""
        raise UsageError("a server is not asked in SQL", _SQL_HINT)

    def annotations(self, from_: Time = None, to: Time = None) -> list[RecordedNote]:
        """Return the notes of a range: those of the robot and those of the server."""
        found = [
            RecordedNote(
                note.note, time_ns(note.at), note.who, note.text, maybe_ns(note.to), note.about,
                note.mission, note.revision,
            )
            for note in self.fleet.notes(self.robot, from_, to)
        ]  # fmt: skip
        return in_range(found, None, None)

    def events(self, from_: Time = None, to: Time = None) -> Table:
        """Return the events of a range, as ``Record.events`` does."""
        return event_table(self, from_, to)


def _info(item: Item) -> ItemInfo:
    first, last = maybe_ns(item.first) or 0, maybe_ns(item.last) or 0
    return ItemInfo(
        item.name, item.source, item.topic, item.type, item.rows, first, last, item.rate_hz, None, 0
    )
