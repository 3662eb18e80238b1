"""What is new in the rows of robots: statuses that differ from the ones before, events, diagnoses.

A robot says all of its statuses every second; most are as they were.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import Connection, select

from amberbox.blackbox.journal import reserved
from amberbox.fleet.linkend.tables import STATUS
from amberbox.fleet.state.said import (
    SaidDiagnosis,
    SaidEvent,
    SaidStatus,
    heard,
    moment,
    status_data,
)
from amberbox.fleet.state.standing import Standing
from amberbox.link.frames import Row

_MOST = 2000
"""Statuses that are remembered of one robot."""
_NUMBER = re.compile(r"\d+(?:[.,]\d+)?")


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


@dataclass(frozen=True, slots=True)
class Changed:
    """A status that is not as it was; ``is_news``: not only in its values."""

    said: SaidStatus
    is_news: bool


class StatusMemory:
    """Remembers what each status was."""

    def __init__(self) -> None:
        self._known: dict[str, dict[tuple[str, str], _Known]] = {}
        self._heard_ns: dict[str, int] = {}

    def load(self, connection: Connection) -> None:
        """Begin with what the board shows."""
        for row in connection.execute(select(STATUS)):
            said = heard(row.data, SaidStatus)
            if said is not None:
                standing = Standing(said, row.log_ns, row.received_ns)
                self._enter(row.robot, _Known(row.store_id, row.run, row.seq, standing))
                self._heard_ns[row.robot] = max(self._heard_ns.get(row.robot, 0), row.received_ns)

    def unheard(self, since_ns: int) -> frozenset[str]:
        """Return the robots whose watchers have said something, and nothing since a time."""
        return frozenset(name for name, at_ns in self._heard_ns.items() if at_ns < since_ns)

    def standing(self, robot: str) -> Mapping[tuple[str, str], Standing]:
        """Return what was said last of each component and mode of a robot."""
        return {key: one.standing for key, one in self._known.get(robot, {}).items()}

    def changed(
        self, robot: str, store_id: str, rows: Iterable[Row], now_ns: int
    ) -> dict[tuple[str, str], Changed]:
        """Return the statuses that are not as they were; those that came late are none."""
        found: dict[tuple[str, str], Changed] = {}
        for row in rows:
            said = heard(row.data, SaidStatus) if row.channel == reserved.STATUS else None
            if said is None:
                continue
            self._heard_ns[robot] = now_ns
            key = said.component, said.mode
            before = self._known.get(robot, {}).get(key)
            if before is not None and _is_late(before, store_id, row):
                continue
            standing = Standing(said, row.log_ns, now_ns)
            self._enter(robot, _Known(store_id, row.run, row.seq, standing))
            if before is None or not _is_same(before.said, said):
                is_news = before is None or not _is_alike(before.said, said)
                found[key] = Changed(said, is_news or (key in found and found[key].is_news))
        return found

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


def _is_alike(one: SaidStatus, other: SaidStatus) -> bool:
    """Tell whether statuses differ in values alone: numbers in reasons count on all the time."""
    return (
        (one.level, one.state) == (other.level, other.state)
        and one.blocked_by == other.blocked_by
        and (one.reason == other.reason or _plain(one.reason) == _plain(other.reason))
    )


def _plain(reason: str) -> str:
    return _NUMBER.sub("#", reason)


def statuses_data(
    changed: Iterable[Mapping[tuple[str, str], Changed]],
) -> Iterator[tuple[Literal["status", "levels"], list[Mapping[str, Any]]]]:
    """Yield what is sent of statuses of a robot that have changed: of each its newest."""
    newest: dict[tuple[str, str], SaidStatus] = {}
    news: set[tuple[str, str]] = set()
    for some in changed:
        newest.update((key, one.said) for key, one in some.items())
        news.update(key for key, one in some.items() if one.is_news)
    yield "status", [status_data(said) for said in newest.values()]
    if news:
        yield "levels", [level_data(newest[key]) for key in newest if key in news]


def level_data(said: SaidStatus) -> Mapping[str, Any]:
    """Return a status without its values, as it is sent."""
    return {"component": said.component, "mode": said.mode, "level": said.level,
            "state": said.state}  # fmt: skip


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
