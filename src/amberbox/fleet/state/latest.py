"""The newest missions and diagnoses of each robot: in memory, read again at a start."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.core.robotstatus import SEVERITIES, Severity
from amberbox.fleet.conclusions.reading import Stores, entries
from amberbox.fleet.knowledge.holding import Hold, gone_since, held_after
from amberbox.fleet.state.said import SaidDiagnosis, SaidMission, SaidSymptom, heard
from amberbox.link.frames import Row

_LOOK_BACK = 200
"""Records of each channel that are read at a start."""
_KEPT = 200
"""Missions and diagnoses that are remembered of a robot."""
_KINDS: Mapping[str, type[msgspec.Struct]] = {
    reserved.MISSION: SaidMission,
    reserved.DIAGNOSIS: SaidDiagnosis,
    reserved.SYMPTOM: SaidSymptom,
}


@dataclass(slots=True)
class Recent:
    """What a robot said last of each mission and diagnosis, the newest at the end."""

    said: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {channel: {} for channel in _KINDS}
    )
    holds: dict[str, Hold] = field(default_factory=dict)
    """Since when each symptom was there last, and when it was seen to be gone."""
    effects: dict[str, tuple[int, Severity | Literal[""]]] = field(default_factory=dict)
    """What diagnoses leave of the robot, as they were put into words last, with their revisions."""

    def take(self, channel: str, data: bytes) -> None:
        """Note a record."""
        found: Any = heard(data, _KINDS[channel])
        if found is not None:
            known = self.said[channel]
            known.pop(found.id, None)
            known[found.id] = found
            if len(known) > _KEPT:
                del known[next(iter(known))]
            if channel == reserved.SYMPTOM:
                self._hold(found)

    def _hold(self, told: SaidSymptom) -> None:
        hold = held_after(self.holds.pop(told.id, None), told)
        if hold is not None:
            self.holds[told.id] = hold
            if len(self.holds) > _KEPT:
                del self.holds[next(iter(self.holds))]

    def explain(self, diagnosis: str, revision: int, severity: str) -> None:
        """Note what a diagnosis leaves of the robot; one of an older revision is passed over."""
        known: Severity | Literal[""] = severity if severity in SEVERITIES else ""
        before = self.effects.pop(diagnosis, (revision, known))
        self.effects[diagnosis] = (revision, known) if revision >= before[0] else before
        if len(self.effects) > _KEPT:
            del self.effects[next(iter(self.effects))]

    @property
    def mission(self) -> SaidMission | None:
        """Return the mission that the robot is on."""
        lasting = [m for m in self.said[reserved.MISSION].values() if m.to_ns is None]
        return lasting[-1] if lasting else None

    @property
    def diagnosis(self) -> SaidDiagnosis | None:
        """Return the diagnosis that the robot made last, as long as it is open."""
        known: list[SaidDiagnosis] = list(self.said[reserved.DIAGNOSIS].values())
        newest = min(known, key=lambda one: (-one.at_ns, one.id), default=None)
        return newest if newest is not None and newest.state == "open" else None

    @property
    def effect(self) -> Severity | Literal[""]:
        """Return what the open diagnosis leaves of the robot, as far as it is put into words."""
        diagnosis = self.diagnosis
        return self.effects[diagnosis.id][1] if diagnosis and diagnosis.id in self.effects else ""

    def gone_ns(self, now_ns: int) -> int | None:
        """Return since when nothing of the open diagnosis is seen; by the robot's clock."""
        diagnosis = self.diagnosis
        return None if diagnosis is None else gone_since(diagnosis.symptoms, self.holds, now_ns)


class Latest:
    """``Recent`` of robots; ``load`` blocks, the rest never does. Threads may share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[str, Recent] = {}
        self._waiting: dict[str, list[Row]] = {}
        self._early: dict[str, tuple[str, int, str]] = {}

    def of(self, robot: str) -> Recent:
        """Return what is known of a robot; nothing before it was loaded."""
        return self._known.get(robot, Recent())

    def explain(self, robot: str, diagnosis: str, revision: int, severity: str) -> None:
        """Note what a diagnosis leaves of a robot."""
        with self._lock:
            if robot in self._known:
                self._known[robot].explain(diagnosis, revision, severity)
            else:
                self._early[robot] = (diagnosis, revision, severity)

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
            if robot in self._early:
                recent.explain(*self._early.pop(robot))
            self._known[robot] = recent


def _add(recent: Recent, records: Iterable[tuple[str, bytes]]) -> None:
    for channel, data in records:
        recent.take(channel, data)
