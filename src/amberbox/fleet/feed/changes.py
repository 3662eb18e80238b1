"""What is new in the rows of robots: statuses that differ from the ones before, events, diagnoses.

A robot says all of its statuses every second; most are as they were.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, select

from amberbox.blackbox.journal import reserved
from amberbox.fleet.linkend.tables import STATUS
from amberbox.fleet.state.said import (
    SaidDiagnosis,
    SaidEvent,
    SaidStatus,
    heard,
    moment,
)
from amberbox.fleet.state.standing import Standing
from amberbox.link.frames import Row

_MOST = 2000
"""Statuses that are remembered of one robot."""


@dataclass(frozen=True, slots=True)
class _Known:
    """The last status of a component or mode, and where it stood."""

    store_id: str
    run: int
    seq: int
    standing: Standing

    @property
    def said(self) -> SaidStatus:
        return self.standing.said


class StatusMemory:
    """Remembers what each status was."""

    def __init__(self) -> None:
        self._known: dict[str, dict[tuple[str, str], _Known]] = {}

    def load(self, connection: Connection) -> None:
        """Begin with what the board shows."""
        for row in connection.execute(select(STATUS)):
            said = heard(row.data, SaidStatus)
            if said is not None:
                standing = Standing(said, row.log_ns, row.received_ns)
                self._enter(row.robot, _Known(row.store_id, row.run, row.seq, standing))

    def standing(self, robot: str) -> Mapping[tuple[str, str], Standing]:
        """Return what was said last of each component and mode of a robot."""
        return {key: one.standing for key, one in self._known.get(robot, {}).items()}

    def changed(
        self, robot: str, store_id: str, rows: Iterable[Row], now_ns: int
    ) -> list[SaidStatus]:
        """Return the statuses that are not as they were; those that came late are none."""
        found: dict[tuple[str, str], SaidStatus] = {}
        for row in rows:
            said = heard(row.data, SaidStatus) if row.channel == reserved.STATUS else None
            if said is None:
                continue
            before = self._known.get(robot, {}).get((said.component, said.mode))
            if before is not None and _is_late(before, store_id, row):
                continue
            standing = Standing(said, row.log_ns, now_ns)
            self._enter(robot, _Known(store_id, row.run, row.seq, standing))
            if before is None or not _is_same(before.said, said):
                found[said.component, said.mode] = said
        return list(found.values())

    def _enter(self, robot: str, known: _Known) -> None:
        statuses = self._known.setdefault(robot, {})
        key = known.said.component, known.said.mode
        if key in statuses or len(statuses) < _MOST:
            statuses[key] = known


def _is_late(before: _Known, store_id: str, row: Row) -> bool:
    return before.store_id == store_id and (row.run, row.seq) <= (before.run, before.seq)


def _is_same(one: SaidStatus, other: SaidStatus) -> bool:
    return (
        (one.level, one.state, one.reason) == (other.level, other.state, other.reason)
        and one.blocked_by == other.blocked_by
        and one.outputs == other.outputs
    )


def event_data(rows: Sequence[Row]) -> list[Mapping[str, Any]]:
    """Return the events among rows as they are sent."""
    found: list[Mapping[str, Any]] = []
    for row in rows:
        said = heard(row.data, SaidEvent) if row.channel == reserved.EVENT else None
        if said is not None:
            at = moment(row.log_ns)
            found.append({"at": at, "kind": said.kind, "text": said.text, "source": said.source})
    return found


def diagnosis_data(rows: Sequence[Row]) -> list[Mapping[str, Any]]:
    """Return the diagnoses among rows as they are sent: of each its newest revision."""
    found: dict[str, Mapping[str, Any]] = {}
    for row in rows:
        said = heard(row.data, SaidDiagnosis) if row.channel == reserved.DIAGNOSIS else None
        if said is not None:
            first = said.hypotheses[0] if said.hypotheses else None
            found[said.id] = {
                "id": said.id,
                "revision": said.revision,
                "state": said.state,
                "at": moment(said.at_ns),
                "faults": first.faults if first else [],
                "probability": first.probability if first else 0.0,
            }
    return list(found.values())
