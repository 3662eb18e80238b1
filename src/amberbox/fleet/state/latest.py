"""The newest missions and diagnoses of each robot: in memory, read again at a start."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.fleet.conclusions.reading import Stores, entries
from amberbox.fleet.state.said import SaidDiagnosis, SaidMission, heard
from amberbox.link.frames import Row

_LOOK_BACK = 200
"""Records of each channel that are read at a start."""
_KEPT = 200
"""Missions and diagnoses that are remembered of a robot."""
_KINDS: Mapping[str, type[msgspec.Struct]] = {
    reserved.MISSION: SaidMission,
    reserved.DIAGNOSIS: SaidDiagnosis,
}


@dataclass(slots=True)
class Recent:
    """What a robot said last of each mission and diagnosis, the newest at the end."""

    said: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {channel: {} for channel in _KINDS}
    )

    def take(self, channel: str, data: bytes) -> None:
        """Note a record."""
        found: Any = heard(data, _KINDS[channel])
        if found is not None:
            known = self.said[channel]
            known.pop(found.id, None)
            known[found.id] = found
            if len(known) > _KEPT:
                del known[next(iter(known))]

    @property
    def mission(self) -> SaidMission | None:
        """Return the mission that the robot is on."""
        lasting = [m for m in self.said[reserved.MISSION].values() if m.to_ns is None]
        return lasting[-1] if lasting else None

    @property
    def diagnosis(self) -> SaidDiagnosis | None:
        """Return the newest diagnosis that has not healed."""
        known = [
            d for d in self.said[reserved.DIAGNOSIS].values() if d.state != "healed" if d.hypotheses
        ]
        return known[-1] if known else None


class Latest:
    """``Recent`` of robots; ``load`` blocks, the rest never does. Threads may share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[str, Recent] = {}
        self._waiting: dict[str, list[Row]] = {}

    def of(self, robot: str) -> Recent:
        """Return what is known of a robot; nothing before it was loaded."""
        return self._known.get(robot, Recent())

    def take(self, robot: str, rows: Sequence[Row]) -> None:
        """Note rows that came; those of a robot that is being loaded come after its past."""
        wanted = [row for row in rows if row.channel in _KINDS]
        if not wanted:
            return
        with self._lock:
            if robot in self._known:
                _add(self._known[robot], ((row.channel, row.data) for row in wanted))
            elif robot in self._waiting:
                self._waiting[robot] += wanted

    def load(self, stores: Stores, robot: str) -> None:
        """Read the past of a robot, once."""
        with self._lock:
            if robot in self._known or robot in self._waiting:
                return
            self._waiting[robot] = []
        recent = Recent()
        try:
            for channel in _KINDS:
                past = entries(stores, robot, channel, limit=_LOOK_BACK, newest=True)
                _add(recent, ((channel, msgspec.json.encode(entry.values)) for entry in past))
        except BaseException:
            with self._lock:
                del self._waiting[robot]
            raise
        with self._lock:
            _add(recent, ((row.channel, row.data) for row in self._waiting.pop(robot)))
            self._known[robot] = recent


def _add(recent: Recent, records: Iterable[tuple[str, bytes]]) -> None:
    for channel, data in records:
        recent.take(channel, data)
