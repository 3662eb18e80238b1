"""The past of a robot as rules look it up, in the archive and in what came over the link."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select

from amberbox.blackbox.missions import Mission
from amberbox.consult.span import Window
from amberbox.diagnosis.rules.intervals import Span
from amberbox.fleet.archive.record import ArchiveRecord
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.conclusions.reading import MOST, entries
from amberbox.fleet.data.recorded import Stores, missions
from amberbox.fleet.linkend.tables import ROW

_Run = tuple[str, int]


def past_of(stores: Stores, robot: str, from_ns: int | None, to_ns: int | None) -> FleetWindow:
    """Open a part of what is known of a robot."""
    record = stores.archive.robot(robot)
    return FleetWindow(record=record, from_ns=from_ns, to_ns=to_ns, stores=stores, robot=robot)


@dataclass(frozen=True, kw_only=True)
class FleetWindow(Window):
    """A part of a robot's past, as the server has it."""

    record: ArchiveRecord
    stores: Stores
    robot: str

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield what the robot's box itself wrote on a channel."""
        for entry in entries(self.stores, self.robot, topic, span, MOST):
            yield {"received": entry.at_ns, **dict.fromkeys(names), **entry.values}

    def missions(self) -> list[Mission]:
        """Return all missions that the server knows of."""
        return missions(self.record.path, self.robot)

    def _runs(self, writers: Collection[str]) -> tuple[Span, ...]:
        found: dict[_Run, Span] = {}
        for run, first, last in (*self._journals(writers), *self._link(writers)):
            known = found.get(run, (first, last))
            found[run] = min(known[0], first), max(known[1], last)
        return tuple(sorted((first, last + 1) for first, last in found.values()))

    def _journals(self, writers: Collection[str]) -> Iterator[tuple[_Run, int, int]]:
        of = JOURNALS.c
        chosen = select(of.store_id, of.run, func.min(of.start_ns), func.max(of.end_ns))
        chosen = chosen.where(of.robot == self.robot, of.writer.in_(writers), of.rows > 0)
        with self.stores.database.reading() as connection:
            for row in connection.execute(chosen.group_by(of.store_id, of.run)):
                yield (row[0], row[1]), int(row[2]), int(row[3])

    def _link(self, writers: Collection[str]) -> Iterator[tuple[_Run, int, int]]:
        of = ROW.c
        chosen = select(of.store_id, of.run, func.min(of.log_ns), func.max(of.log_ns))
        chosen = chosen.where(of.robot == self.robot, of.writer.in_(writers))
        with self.stores.database.reading() as connection:
            for row in connection.execute(chosen.group_by(of.store_id, of.run)):
                yield (row[0], row[1]), int(row[2]), int(row[3])
