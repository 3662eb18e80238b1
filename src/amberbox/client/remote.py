"""The record of a robot as a server has it: the same questions as on the robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.blackbox.query.overview import ItemInfo
from amberbox.blackbox.query.record import By, Record, Time
from amberbox.blackbox.query.table import Table
from amberbox.client import tables
from amberbox.client.times import maybe_ns, time_ns
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.names import identifier
from amberbox.core.types import Column, Gap, ItemSchema

if TYPE_CHECKING:
    from amberbox.blackbox.missions import Mission
    from amberbox.client.data_models import Item
    from amberbox.client.fleet import Fleet

_SQL_HINT = (
    "amberbox export URL -o robot.mcap, then amberbox sql robot.mcap; on the server itself: "
    "amberbox sql DIR"
)
NOT_YET = "not on the server yet"
"""Why there is a gap where the robot has something that was not copied."""
DRAWN_ROWS = 200_000
"""Rows that are drawn as they are; of more, the server thins them out."""


@dataclass(frozen=True, kw_only=True)
class RemoteRecord(Record):
    """A robot's record on a server; ``path`` is only its name here."""

    fleet: Fleet = field(repr=False)
    robot: str = ""

    def __enter__(self) -> RemoteRecord:
        return self

    def close(self) -> None:
        """Let the connection go."""
        self.fleet.close()

    def items(self) -> list[ItemInfo]:
        """Return what the server has rows of; stamps and sizes are not known there."""
        return [_info(item) for item in self.fleet.items(self.robot)]

    def variables(self, item: str) -> ItemSchema:
        """Return the columns of an item."""
        found = self.fleet.item(self.robot, item)
        columns = tuple(_column(one) for one in found.columns)
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
        missions: Sequence[Mission] | None = None,
    ) -> Table:
        """Return rows as on the robot (see ``Record.query``)."""
        if missions is not None:
            from amberbox.blackbox.missions.windows import query_missions

            return query_missions(
                missions, lambda start, end: self.query(item, variables, start, end, by, points)
            )
        _check(by, points)
        pages = [*self.fleet.pages(self.robot, item, variables, from_, to, by, points)]
        if pages[0].kind == "envelope":
            known = {column.name: column for column in self.variables(item).columns}
            return tables.as_rows(pages[0].table, known)
        return tables.joined([page.table for page in pages])

    def drawn(
        self, item: str, variables: Sequence[str], span: tuple[Time, Time], by: By, points: int
    ) -> tuple[Table, bool]:
        """Return what a plot shows; all rows of a short range, of a long one the thinned ones."""
        pages = self.fleet.pages(self.robot, item, variables, *span, by, None, DRAWN_ROWS)
        first = next(pages)
        if not first.next:
            return first.table, True
        return self.query(item, variables, *span, by, points), False

    def last_ns(self) -> int | None:
        """Return when the newest row that the server has was received."""
        return max((info.last_ns for info in self.items()), default=None)

    def gaps(self, item: str | None = None, from_: Time = None, to: Time = None) -> list[Gap]:
        """Return what is missing in ``[from_, to)`` and why, also what never came to the server."""
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
    ) -> list[Mission]:
        """Return missions in order of their start: those of the robot and of the server."""
        from amberbox.blackbox.missions.mission import Mission, Moment, choose

        found = [
            Mission(
                m.id, m.name, Moment(time_ns(m.from_)),
                None if m.to is None else Moment(time_ns(m.to)),
                m.outcome, m.failed, m.who, m.parameters,
            )
            for m in self.fleet.missions(self.robot)
        ]  # fmt: skip
        found.sort(key=lambda mission: (mission.from_ns, mission.id))
        return choose(found, name, failed=failed, last=last)

    def incident_windows(self, incident: str) -> list[tuple[int, int]]:
        """Return the window of an incident; ``last`` is the newest one."""
        known = {one.id: one for one in self.fleet.incidents(self.robot)}
        chosen = next(iter(known.values()), None) if incident == "last" else known.get(incident)
        if chosen is None:
            near = did_you_mean(incident, known)
            raise UsageError(f"there is no incident '{incident}'{near}", "amberbox incident list")
        return [(time_ns(chosen.from_), time_ns(chosen.to))]

    def clock(self) -> ClockBook:
        """Return nothing: the server has put the times right already."""
        return ClockBook()

    def sql(self, statement: str) -> NoReturn:
        """Refuse: SQL of somebody else's is not run on a server."""
        raise UsageError("a server is not asked in SQL", _SQL_HINT)

    def events(self, from_: Time = None, to: Time = None) -> Table:
        """Return what happened to the box."""
        name = identifier(reserved.EVENT)
        if all(item.name != name for item in self.fleet.items(self.robot)):
            stamp = Column("timestamp", "timestamp", "time")
            return Table("events", (stamp,), {"timestamp": np.empty(0, np.int64)})
        return self.query(name, None, from_, to)

    def _ask(self, question: Callable[..., Any]) -> NoReturn:
        raise UsageError(
            "this cannot be asked of a server", "amberbox export downloads what is recorded"
        )


def _check(by: str, points: int | None) -> None:
    if by not in ("received", "timestamp"):
        raise UsageError(f"rows are ordered by received or timestamp, not by {by!r}")
    if points is not None and points < 1:
        raise UsageError("points must be 1 or more")


def _info(item: Item) -> ItemInfo:
    first, last = maybe_ns(item.first) or 0, maybe_ns(item.last) or 0
    return ItemInfo(
        item.name, item.source, item.topic, item.type, item.rows, first, last, item.rate_hz, None, 0
    )


def _column(said: Any) -> Column:
    labels = {int(number): text for number, text in said.labels.items()}
    return Column(said.name, said.path, said.type, said.unit, labels)
