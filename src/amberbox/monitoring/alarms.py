"""Alarms: one for each component with a fault of its own, until it has recovered."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any, Final, Literal, TypeAlias, get_args

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.robot_status import RANK, SEVERITIES, Severity
from amberbox.core.types import Level
from amberbox.monitoring.component_states import Blocker, OwnState
from amberbox.monitoring.findings import AlarmChange, AlarmState

REOPEN_NS: Final = 60 * NS  # a fault that returns within this reopens its alarm
SETTLE_NS: Final = 5 * NS  # time to recover after the blocking dependency has
NEVER_NS: Final = 1 << 62
# start of the reason of an alarm that another component's fault explains
FOLLOWS: Final = "follows from "

Action: TypeAlias = Literal["acknowledge", "shelve", "unshelve", "resolve"]
_RAISING: Final[frozenset[Level]] = frozenset(("warn", "stale", "error"))


@dataclass(frozen=True, slots=True)
class _Alarm:
    """An alarm as a replay finds it too; ``healed_ns`` is None while it lasts."""

    id: str
    severity: Severity
    level: Level
    reason: str
    opened_ns: int
    changed_ns: int
    count: int = 1
    healed_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PersonAction:
    """What a person does with an alarm at a time (ns); shelving has an end.

    ``command`` is the id of the server's command by which it came, empty for one given here.
    """

    action: Action
    who: str
    at_ns: int
    until_ns: int | None = None
    note: str = ""
    command: str = ""


@dataclass(frozen=True, slots=True)
class _UserAction:
    """A person's action: on the alarm of this id, or (shelved) on all until a time."""

    state: AlarmState
    id: str
    who: str
    at_ns: int
    until_ns: int | None = None
    note: str = ""
    command: str = ""


_STATES: Final[Mapping[Action, AlarmState]] = {
    "acknowledge": "acknowledged", "shelve": "shelved", "unshelve": "open", "resolve": "resolved",
}  # fmt: skip


class ComponentAlarms:
    """The alarms of a robot, by component."""

    def __init__(self, robot: str, config_hash: str) -> None:
        self._about = robot, config_hash
        self._alarms: dict[str, _Alarm] = {}
        self._user_actions: dict[str, _UserAction] = {}
        self._blocked: set[str] = set()
        self._settling: dict[str, int] = {}
        self._timers: list[tuple[int, str]] = []

    def next_ns(self) -> int:
        """Return the next instant (ns) at which an alarm may change without new findings."""
        return self._timers[0][0] if self._timers else NEVER_NS

    def due(self, now_ns: int) -> tuple[list[str], list[AlarmChange]]:
        """Return components to evaluate again, and alarms whose shelving has ended."""
        again, changes = [], []
        while self._timers and self._timers[0][0] <= now_ns:
            _, component = heapq.heappop(self._timers)
            if self._settling.get(component, NEVER_NS) <= now_ns:
                del self._settling[component]
                again.append(component)
            user_action = self._user_actions.get(component)
            if (
                user_action is not None
                and user_action.until_ns is not None
                and user_action.until_ns <= now_ns
            ):
                changes += self._withdraw(component, _UserAction("open", "", "", now_ns))
        return again, changes

    def update(
        self, component: str, now_ns: int, own: OwnState, waits: Sequence[Blocker]
    ) -> list[AlarmChange]:
        """Update the alarm of a component by its modes and by what blocks it."""
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
        self, component: str, now_ns: int, own: OwnState, waits: Sequence[Blocker]
    ) -> None:
        """Record whether a component is blocked; after that it has ``SETTLE_NS`` to recover."""
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
        self, component: str, last: _Alarm | None, now_ns: int, own: OwnState
    ) -> list[AlarmChange]:
        alarm_id = f"{component}-{datetime.fromtimestamp(now_ns // NS, UTC):%Y%m%dt%H%M%S}"
        about = own.severity, own.level, own.reason
        if last is not None and (alarm_id == last.id or not _is_over(last, now_ns)):
            count = last.count + 1
            alarm = _Alarm(last.id, *about, last.opened_ns, now_ns, count)
        else:
            alarm = _Alarm(alarm_id, *about, now_ns, now_ns)
            self._forget_acknowledgement(component)
        return self._changed(component, alarm)

    def _worsen(
        self, component: str, alarm: _Alarm, now_ns: int, own: OwnState
    ) -> list[AlarmChange]:
        """Raise severity or level; an acknowledgement of the lower one no longer counts.

        Nor is it resolved any more.
        """
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
        """Record an active alarm, then a person's action on it."""
        self._alarms[component] = alarm
        user_action = self._user_actions.get(component)
        first = self._record(component, alarm, None)
        return (
            [first] if user_action is None else [first, self._record(component, alarm, user_action)]
        )

    def _forget_acknowledgement(self, component: str) -> None:
        user_action = self._user_actions.get(component)
        if user_action is not None and user_action.state in ("acknowledged", "resolved"):
            del self._user_actions[component]

    def command(self, alarm_id: str, done: PersonAction) -> list[AlarmChange]:
        """Apply a person's action to an active alarm; shelving needs an end.

        Raises UsageError if there is no such alarm, or the action does not apply to it.
        """
        lasting = {a.id: (c, a) for c, a in self._alarms.items() if a.healed_ns is None}
        if alarm_id not in lasting:
            raise UsageError(
                f"there is no alarm '{alarm_id}' now{did_you_mean(alarm_id, lasting)}",
                "amberbox alarm list WHERE shows them",
            )
        component, alarm = lasting[alarm_id]
        if done.action not in get_args(Action):
            raise UsageError(f"'{done.action}' is nothing that can be done with an alarm")
        until_ns = done.until_ns if done.action == "shelve" else None
        user_action = _UserAction(
            _STATES[done.action], alarm.id, done.who, done.at_ns, until_ns, done.note, done.command
        )
        if done.action == "unshelve":
            if self._state(component) != "shelved":
                raise UsageError(f"the alarm '{alarm_id}' is not shelved")
            return self._withdraw(component, user_action)
        if done.action == "shelve" and (until_ns is None or until_ns <= done.at_ns):
            raise UsageError("an alarm is shelved for some time", "--for 2h")
        self._user_actions[component] = user_action
        if user_action.until_ns is not None:
            heapq.heappush(self._timers, (user_action.until_ns, component))
        return [self._record(component, alarm, user_action)]

    def _withdraw(self, component: str, by: _UserAction) -> list[AlarmChange]:
        """Withdraw a person's action; an active alarm is open again."""
        del self._user_actions[component]
        alarm = self._alarms[component]
        if alarm.healed_ns is not None:
            return []
        return [self._record(component, alarm, by)]

    def _state(self, component: str) -> AlarmState:
        alarm, user_action = self._alarms[component], self._user_actions.get(component)
        if alarm.healed_ns is not None:
            return "healed"
        return "open" if user_action is None else user_action.state

    def active(self) -> list[AlarmChange]:
        """Return the active alarms in their present state."""
        lasting = [(c, alarm) for c, alarm in self._alarms.items() if alarm.healed_ns is None]
        return [self._record(c, alarm, self._user_actions.get(c)) for c, alarm in lasting]

    def _record(self, component: str, alarm: _Alarm, action: _UserAction | None) -> AlarmChange:
        robot, config_hash = self._about
        state: AlarmState = "open" if alarm.healed_ns is None else "healed"
        changed_ns = alarm.changed_ns if action is None else max(alarm.changed_ns, action.at_ns)
        return AlarmChange(
            robot, alarm.id, component, alarm.severity, state if action is None else action.state,
            alarm.level, alarm.reason, alarm.opened_ns, changed_ns, alarm.count,
            "" if action is None else action.who, None if action is None else action.until_ns,
            config_hash, live_only=action is not None,
            note="" if action is None else action.note,
            said_ns=action.at_ns if action is not None and action.who else None,
            command="" if action is None else action.command,
        )  # fmt: skip

    def drop(self, known: Collection[str], now_ns: int) -> list[AlarmChange]:
        """Heal the alarms of components that are monitored no more."""
        changes = []
        for component in [c for c in self._alarms if c not in known]:
            alarm = self._alarms[component]
            if alarm.healed_ns is None:
                changes += self._heal(component, alarm, now_ns, "no longer monitored")
            del self._alarms[component]
            self._user_actions.pop(component, None)
        return changes

    def snapshot(self, now_ns: int) -> dict[str, Any]:
        """Return the state needed by ``resume``."""
        alarms = {
            component: asdict(alarm)
            for component, alarm in self._alarms.items()
            if alarm.healed_ns is None
            or not _is_over(alarm, now_ns)
            or component in self._user_actions
        }
        user_actions = {
            component: asdict(user_action) for component, user_action in self._user_actions.items()
        }
        return {"alarms": alarms, "says": user_actions, "blocked": sorted(self._blocked),
                "settling": self._settling}  # fmt: skip

    def resume(self, snapshot_values: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._alarms = {c: _Alarm(**values) for c, values in snapshot_values["alarms"].items()}
        self._user_actions = {
            c: _UserAction(**values) for c, values in snapshot_values["says"].items()
        }
        self._blocked = set(snapshot_values["blocked"])
        self._settling = dict(snapshot_values["settling"])
        self._timers = [(at_ns, c) for c, at_ns in self._settling.items()]
        ends = ((user_action.until_ns, c) for c, user_action in self._user_actions.items())
        self._timers += [(at_ns, c) for at_ns, c in ends if at_ns is not None]
        heapq.heapify(self._timers)


def _is_over(alarm: _Alarm, now_ns: int) -> bool:
    """Return whether it healed so long ago that a returning fault is another alarm."""
    return alarm.healed_ns is not None and abs(now_ns - alarm.healed_ns) > REOPEN_NS
