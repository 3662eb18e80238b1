"""Alarms: one for each component whose own fault it is, until it is well again.

What replay sees too (opened, worse, healed) and what people do (acknowledge, shelve) are kept
apart: each change of the first kind is one record, the same live and in replay; where a person
has had a say, a second record, ``live_only``, follows with that applied. So the newest record of
an alarm is how it stands.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final, Literal, TypeAlias, get_args

from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.types import Level
from amberbox.monitoring.engine.components import Own
from amberbox.monitoring.engine.edges import Blocker
from amberbox.monitoring.engine.findings import AlarmChange, AlarmState
from amberbox.monitoring.engine.outputs import RANK, SEVERITIES
from amberbox.monitoring.plan import Severity

REOPEN_NS: Final = 60 * NS
"""A fault that comes back so soon is the same alarm, counted once more."""
SETTLE_NS: Final = 5 * NS
"""So long a component has to recover after what blocked it has."""
NEVER_NS: Final = 1 << 62
FOLLOWS: Final = "follows from "
"""Begins the reason of an alarm that is over since another component is to blame."""

Action: TypeAlias = Literal["acknowledge", "shelve", "unshelve"]
_RAISING: Final[frozenset[Level]] = frozenset(("warn", "stale", "error"))


@dataclass(frozen=True, slots=True)
class _Alarm:
    """An alarm as replay sees it too; ``healed_ns`` is None while it lasts."""

    id: str
    severity: Severity
    level: Level
    reason: str
    opened_ns: int
    changed_ns: int
    count: int = 1
    healed_ns: int | None = None


@dataclass(frozen=True, slots=True)
class _Say:
    """What a person said: about the alarm of this id, or (shelved) about all until a time."""

    state: AlarmState
    id: str
    who: str
    at_ns: int
    until_ns: int | None = None


class Alarms:
    """The alarms of a robot, by component."""

    def __init__(self, robot: str, config_hash: str) -> None:
        self._about = robot, config_hash
        self._alarms: dict[str, _Alarm] = {}
        self._says: dict[str, _Say] = {}
        self._blocked: set[str] = set()
        self._settling: dict[str, int] = {}
        self._timers: list[tuple[int, str]] = []

    def next_ns(self) -> int:
        """Return the next instant at which something may happen by itself."""
        return self._timers[0][0] if self._timers else NEVER_NS

    def due(self, now_ns: int) -> tuple[list[str], list[AlarmChange]]:
        """Return components to look at again, and alarms that are shelved no longer."""
        again, changes = [], []
        while self._timers and self._timers[0][0] <= now_ns:
            _, component = heapq.heappop(self._timers)
            if self._settling.get(component, NEVER_NS) <= now_ns:
                del self._settling[component]
                again.append(component)
            say = self._says.get(component)
            if say is not None and say.until_ns is not None and say.until_ns <= now_ns:
                changes += self._unsay(component, now_ns)
        return again, changes

    def update(
        self, component: str, now_ns: int, own: Own, waits: Sequence[Blocker]
    ) -> list[AlarmChange]:
        """Look at a component: what its modes say, and what blocks it."""
        alarm = self._alarms.get(component)
        lasts = alarm is not None and alarm.healed_ns is None
        self._note_blocked(component, now_ns, own, waits)
        if alarm is not None and lasts and own.level == "ok":
            return self._heal(component, alarm, now_ns, "")
        if own.level not in _RAISING:
            return []
        if waits:
            origin = next((wait.label for wait in waits if wait.faulty), "")
            if alarm is not None and lasts and origin:
                return self._heal(component, alarm, now_ns, FOLLOWS + origin)
            return []
        if alarm is not None and lasts:
            return self._worsen(component, alarm, now_ns, own)
        if component in self._settling:
            return []
        return self._open(component, alarm, now_ns, own)

    def _note_blocked(
        self, component: str, now_ns: int, own: Own, waits: Sequence[Blocker]
    ) -> None:
        """Give what still fails when it is blocked no more some time to recover."""
        if waits or own.level == "ok":
            self._settling.pop(component, None)
        if waits:
            self._blocked.add(component)
        elif component in self._blocked:
            self._blocked.discard(component)
            if own.level in _RAISING:
                self._settling[component] = now_ns + SETTLE_NS
                heapq.heappush(self._timers, (now_ns + SETTLE_NS, component))

    def _open(
        self, component: str, last: _Alarm | None, now_ns: int, own: Own
    ) -> list[AlarmChange]:
        alarm_id = _id_of(component, now_ns)
        about = own.severity, own.level, own.reason
        if last is not None and _is_same(last, alarm_id, now_ns):
            count = last.count + 1
            alarm = _Alarm(last.id, *about, last.opened_ns, now_ns, count)
        else:
            alarm = _Alarm(alarm_id, *about, now_ns, now_ns)
            self._forget_acknowledgement(component)
        return self._changed(component, alarm)

    def _worsen(self, component: str, alarm: _Alarm, now_ns: int, own: Own) -> list[AlarmChange]:
        """Tell when it is worse than it has been: that is not what was acknowledged."""
        more_severe = SEVERITIES.index(own.severity) > SEVERITIES.index(alarm.severity)
        higher = RANK[own.level] > RANK[alarm.level]
        if not (more_severe or higher):
            return []
        self._forget_acknowledgement(component)
        severity = own.severity if more_severe else alarm.severity
        level = own.level if higher else alarm.level
        worse = replace(alarm, severity=severity, level=level, reason=own.reason, changed_ns=now_ns)
        return self._changed(component, worse)

    def _heal(self, component: str, alarm: _Alarm, now_ns: int, reason: str) -> list[AlarmChange]:
        healed = replace(alarm, healed_ns=now_ns, changed_ns=now_ns, reason=reason or alarm.reason)
        self._alarms[component] = healed
        return [self._record(component, healed, None)]

    def _changed(self, component: str, alarm: _Alarm) -> list[AlarmChange]:
        """Record an alarm that lasts, and what a person said of it after that."""
        self._alarms[component] = alarm
        say = self._says.get(component)
        first = self._record(component, alarm, None)
        return [first] if say is None else [first, self._record(component, alarm, say)]

    def _forget_acknowledgement(self, component: str) -> None:
        say = self._says.get(component)
        if say is not None and say.state == "acknowledged":
            del self._says[component]

    def command(
        self, action: Action, alarm_id: str, who: str, at_ns: int, until_ns: int | None = None
    ) -> list[AlarmChange]:
        """Do what a person says of an alarm that lasts; shelving needs an end.

        Raises UsageError if there is no such alarm, or it makes no sense for it.
        """
        component, alarm = self._lasting(alarm_id)
        if action not in get_args(Action):
            raise UsageError(f"'{action}' is nothing that can be done with an alarm")
        if action == "unshelve":
            if self._state(component) != "shelved":
                raise UsageError(f"the alarm '{alarm_id}' is not shelved")
            return self._unsay(component, at_ns, who)
        if action == "shelve" and (until_ns is None or until_ns <= at_ns):
            raise UsageError("an alarm is shelved for some time", "--for 2h")
        state: AlarmState = "shelved" if action == "shelve" else "acknowledged"
        say = _Say(state, alarm.id, who, at_ns, until_ns if state == "shelved" else None)
        self._says[component] = say
        if say.until_ns is not None:
            heapq.heappush(self._timers, (say.until_ns, component))
        return [self._record(component, alarm, say)]

    def _lasting(self, alarm_id: str) -> tuple[str, _Alarm]:
        lasting = {a.id: (c, a) for c, a in self._alarms.items() if a.healed_ns is None}
        if alarm_id not in lasting:
            raise UsageError(
                f"there is no alarm '{alarm_id}' now{did_you_mean(alarm_id, lasting)}",
                "amberbox alarm list WHERE shows them",
            )
        return lasting[alarm_id]

    def _unsay(self, component: str, now_ns: int, who: str = "") -> list[AlarmChange]:
        """Forget what was said; an alarm that lasts is open again."""
        del self._says[component]
        alarm = self._alarms[component]
        if alarm.healed_ns is not None:
            return []
        return [self._record(component, alarm, _Say("open", alarm.id, who, now_ns))]

    def _state(self, component: str) -> AlarmState:
        alarm, say = self._alarms[component], self._says.get(component)
        if alarm.healed_ns is not None:
            return "healed"
        return "open" if say is None else say.state

    def standing(self) -> list[AlarmChange]:
        """Return the alarms that last, as they stand."""
        lasting = [(c, alarm) for c, alarm in self._alarms.items() if alarm.healed_ns is None]
        return [self._record(c, alarm, self._says.get(c)) for c, alarm in lasting]

    def _record(self, component: str, alarm: _Alarm, say: _Say | None) -> AlarmChange:
        robot, config_hash = self._about
        state: AlarmState = "open" if alarm.healed_ns is None else "healed"
        changed_ns = alarm.changed_ns if say is None else max(alarm.changed_ns, say.at_ns)
        return AlarmChange(
            robot, alarm.id, component, alarm.severity, state if say is None else say.state,
            alarm.level, alarm.reason, alarm.opened_ns, changed_ns, alarm.count,
            "" if say is None else say.who, None if say is None else say.until_ns,
            config_hash, live_only=say is not None,
        )  # fmt: skip

    def drop(self, known: Collection[str], now_ns: int) -> list[AlarmChange]:
        """Heal the alarms of components that are monitored no more."""
        changes = []
        for component in [c for c in self._alarms if c not in known]:
            alarm = self._alarms[component]
            if alarm.healed_ns is None:
                changes += self._heal(component, alarm, now_ns, "no longer monitored")
            del self._alarms[component]
            self._says.pop(component, None)
        return changes

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """Return what has to be known to go on."""
        alarms = {
            component: asdict(alarm)
            for component, alarm in self._alarms.items()
            if alarm.healed_ns is None or not _is_over(alarm, now_ns) or component in self._says
        }
        says = {component: asdict(say) for component, say in self._says.items()}
        return {"alarms": alarms, "says": says, "blocked": sorted(self._blocked),
                "settling": self._settling}  # fmt: skip

    def resume(self, held: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._alarms = {c: _Alarm(**values) for c, values in held["alarms"].items()}
        self._says = {c: _Say(**values) for c, values in held["says"].items()}
        self._blocked = set(held["blocked"])
        self._settling = dict(held["settling"])
        self._timers = [(at_ns, c) for c, at_ns in self._settling.items()]
        ends = ((say.until_ns, c) for c, say in self._says.items())
        self._timers += [(at_ns, c) for at_ns, c in ends if at_ns is not None]
        heapq.heapify(self._timers)


def _id_of(component: str, opened_ns: int) -> str:
    return f"{component}-{datetime.fromtimestamp(opened_ns // NS, UTC):%Y%m%dt%H%M%S}"


def _is_same(last: _Alarm, alarm_id: str, now_ns: int) -> bool:
    """Tell whether an alarm that opens now goes on with the last one of the component."""
    return alarm_id == last.id or not _is_over(last, now_ns)


def _is_over(alarm: _Alarm, now_ns: int) -> bool:
    """Tell whether it healed so long ago that what comes is another alarm."""
    return alarm.healed_ns is not None and abs(now_ns - alarm.healed_ns) > REOPEN_NS
