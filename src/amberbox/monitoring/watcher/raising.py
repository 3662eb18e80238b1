"""Alarms that a diagnosis raises itself: of causes that are urgent or worse and have none."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from amberbox.core.clock import NS
from amberbox.core.types import Level
from amberbox.monitoring.engine.alarms import NEVER_NS, Action, Alarms
from amberbox.monitoring.engine.components import NO_MONITOR, Own
from amberbox.monitoring.engine.edges import Blocker
from amberbox.monitoring.engine.findings import AlarmChange
from amberbox.monitoring.watcher.blame import URGENT, Blame, Cause, Share, component_of

GATHER_NS: Final = 2 * NS
"""So long what belongs to one onset is gathered before it has an alarm of its own."""
_NAMED: Final = 3
_WELL: Final = Own("ok", "nominal", "", "warning")


class Raised:
    """Alarms by failure mode: ``look`` wherever diagnosis or alarms have changed.

    A cause has an alarm once: what has had one of a monitor's, or of this, has none again until
    the diagnosis has given it up.
    """

    def __init__(self, robot: str = "", config_hash: str = "") -> None:
        self._alarms = Alarms(robot, config_hash)
        self._due_ns: dict[str, int] = {}
        self._had: set[str] = set()

    def next_ns(self) -> int:
        """Return the next instant at which something may happen by itself."""
        return min([self._alarms.next_ns(), *self._due_ns.values()], default=NEVER_NS)

    def standing(self) -> list[AlarmChange]:
        """Return the alarms that last, as they stand."""
        return [_public(alarm) for alarm in self._alarms.standing()]

    def look(
        self, blame: Blame, others: Iterable[tuple[AlarmChange, Share]], now_ns: int
    ) -> list[AlarmChange]:
        """Raise and heal alarms; ``others`` are those of monitors that last, and their causes."""
        again, changes = self._alarms.due(now_ns)
        standing = {alarm.component for alarm in self._alarms.standing()}
        causes = {self._key(cause, standing): cause for cause in blame.causes()}
        gone = sorted(standing - causes.keys())
        covered = _covered(causes, others)
        new = [key for key in causes if key not in standing | self._had | self._due_ns.keys()]
        self._had = (self._had | covered) & causes.keys()
        for key in causes:
            if key in self._had or not causes[key].is_credible:
                self._due_ns.pop(key, None)
            else:  # an alarm whose cause is another now is not given up before that has its own
                self._due_ns.setdefault(key, now_ns if gone else now_ns + GATHER_NS)
        self._due_ns = {key: at_ns for key, at_ns in self._due_ns.items() if key in causes}
        for key, cause in causes.items():
            if key in standing or key in again or self._due_ns.get(key, NEVER_NS) <= now_ns:
                changes += self._alarms.update(key, now_ns, _own(cause), ())
                self._due_ns.pop(key, None)
                self._had.add(key)
        instead = [Blocker(component_of(key), "", "", 0, faulty=True) for key in new[:1]]
        for key in gone:
            own = NO_MONITOR._replace(level="error") if instead else _WELL
            changes += self._alarms.update(key, now_ns, own, instead)
        return [_public(change) for change in changes]

    def _key(self, cause: Cause, standing: Collection[str]) -> str:
        """Return the failure mode that a cause goes by: one that has an alarm, else the first."""
        keys = [fault.replace("#", ".") for fault in cause.faults]
        known = [standing, self._had, self._due_ns]
        return next((key for some in known for key in keys if key in some), keys[0])

    def command(
        self, action: Action, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> list[AlarmChange]:
        """Do what a person says of an alarm; raises UsageError if that makes no sense."""
        return [_public(c) for c in self._alarms.command(action, alarm_id, who, at_ns, until_ns)]

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """Return what has to be known to go on, as JSON."""
        had = sorted(self._had)
        return {"alarms": self._alarms.snapshot(now_ns), "due_ns": self._due_ns, "had": had}

    def resume(self, held: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._alarms.resume(held["alarms"])
        self._due_ns, self._had = dict(held["due_ns"]), set(held["had"])


def _covered(causes: Mapping[str, Cause], others: Iterable[tuple[AlarmChange, Share]]) -> set[str]:
    """Return the causes of which a monitor has an alarm that is urgent or worse."""
    urgent = [frozenset[str]().union(*share) for alarm, share in others if alarm.severity in URGENT]
    return {key for key, cause in causes.items() if any(s & {*cause.faults} for s in urgent)}


def _own(cause: Cause) -> Own:
    names = ", ".join(cause.symptoms[:_NAMED])
    more = len(cause.symptoms) - _NAMED
    reason = f"diagnosed from {names}" + (f" and {more} more" if more > 0 else "")
    level: Level = "warn" if cause.severity == "urgent" else "error"
    return Own(level, "diagnosed", reason, cause.severity)


def _public(alarm: AlarmChange) -> AlarmChange:
    return replace(alarm, component=component_of(alarm.component))
