"""What robots say about alarms, read from the rows of their journals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, TypeAlias

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.core.types import Diagnosis
from amberbox.fleet.conclusions.findings import finding
from amberbox.link.frames import Row
from amberbox.monitoring.engine.findings import AlarmChange, Transition

CHANNELS: Final = frozenset({reserved.ALARM, reserved.DIAGNOSIS, reserved.EVENT})
"""Channels that alarms are made of."""
Told: TypeAlias = AlarmChange | Diagnosis | Transition


@dataclass(frozen=True, slots=True)
class Received:
    """A row of a robot, and when it came by the server's clock."""

    robot: str
    store_id: str
    row: Row
    received_ns: int


@dataclass(frozen=True, slots=True)
class Report:
    """What a robot said. ``offset_ns`` makes its times ours; ``late`` is what came long after."""

    robot: str
    store_id: str
    run: int
    seq: int
    told: Told
    offset_ns: int
    late: bool


Offsets: TypeAlias = Mapping[tuple[str, str, str, int], int | None]
"""By robot, store, writer and run: the server's clock minus the robot's, None if nobody knows."""


def is_of_interest(row: Row) -> bool:
    """Tell whether a row can say something about alarms, without reading it."""
    if row.channel == reserved.EVENT:
        return b'"component_state"' in row.data
    return row.channel in CHANNELS


def reports(rows: Iterable[Received], offsets: Offsets, late_ns: int) -> Iterator[Report]:
    """Read rows in the order in which they were written; what cannot be read is left out.

    A row whose clock nobody knows is late: what came of it is listed, nobody is woken for it.
    """
    for one in sorted(rows, key=_order):
        told = _told(one.row)
        if told is None:
            continue
        row = one.row
        offset_ns = offsets.get((one.robot, one.store_id, row.writer, row.run))
        late = offset_ns is None or one.received_ns - row.log_ns - offset_ns > late_ns
        yield Report(one.robot, one.store_id, row.run, row.seq, told, offset_ns or 0, late)


def _order(one: Received) -> tuple[str, str, str, int, int]:
    return (one.robot, one.store_id, one.row.writer, one.row.run, one.row.seq)


def _told(row: Row) -> Told | None:
    """Return what a row says; None for nonsense, which the ledger keeps all the same."""
    try:
        found = finding(row.channel, msgspec.json.decode(row.data))
    except msgspec.MsgspecError:
        return None
    return found if isinstance(found, Told) else None
