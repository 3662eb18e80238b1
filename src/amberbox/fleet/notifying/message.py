"""What people read about alarms: subject, text, and the same for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeAlias

from amberbox.core.showing import one_line
from amberbox.core.timetext import format_time
from amberbox.fleet.alarms.alarm import Alarm

VERSION: Final = 1
"""Of what programs get: goes up when a field changes its meaning, not when one is added."""

Event: TypeAlias = Literal["opened", "acknowledged", "resolved"]
"""What a message says of an alarm; ``opened`` also when it got worse or came back."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message to one destination; ``key`` is the same at every attempt to deliver it.

    ``thread`` is the key of the first message about the same alarm to the same destination.
    """

    key: str
    subject: str
    body: str
    data: dict[str, Any] = field(default_factory=dict)
    thread: str = ""


def subject_of(alarm: Alarm, event: Event = "opened") -> str:
    """Return an alarm in a few words: ``critical: ropod_001 laser``, with what became of it."""
    whose = alarm.robot or "several robots:"
    what = "" if event == "opened" else f"{event}: "
    return one_line(f"{what}{alarm.severity}: {whose} {alarm.origin}")[:200]


def body_of(alarm: Alarm, url: str, now_ns: int, event: Event = "opened") -> str:
    """Return what is to be said about an alarm."""
    lasts = "it lasts" if alarm.active else "it has ended meanwhile"
    lines = [
        subject_of(alarm, event),
        *_became(alarm, event),
        one_line(alarm.reason),
        *([f"cause: {one_line(alarm.cause)}"] if alarm.cause else []),
        f"since {format_time(alarm.opened_ns)[:19]}Z, {lasts}",
        *([f"it came {alarm.count} times"] if alarm.count > 1 else []),
        *(["the robot was offline when it happened"] if alarm.late else []),
        *([f"{url}/alarms/{alarm.number}"] if url else []),
    ]
    return "\n".join(lines)


def _became(alarm: Alarm, event: Event) -> list[str]:
    """Return who acknowledged or resolved an alarm, when, and why."""
    if event == "opened":
        return []
    by, at_ns = _who_and_when(alarm, event)
    who = f" by {by}" if by else ""
    why = f": {alarm.resolution}" if event == "resolved" and by and alarm.resolution else ""
    return [one_line(f"{event}{who} {format_time(at_ns or 0)[:19]}Z{why}")]


def _who_and_when(alarm: Alarm, event: Event) -> tuple[str, int | None]:
    if event == "acknowledged":
        return alarm.acknowledged_by, alarm.acknowledged_ns
    if event == "resolved":
        return alarm.resolved_by, alarm.resolved_ns
    return "", alarm.opened_ns


def data_of(
    alarm: Alarm, robots: Sequence[str], url: str, event: Event = "opened"
) -> dict[str, Any]:
    """Return an alarm as programs get it."""
    by, at_ns = _who_and_when(alarm, event)
    return {
        "type": "alarm",
        "version": VERSION,
        "event": event,
        "at": None if at_ns is None else format_time(at_ns),
        "by": by,
        "resolution": alarm.resolution,
        "merged_into": alarm.merged_into,
        "id": alarm.number,
        "robots": list(robots),
        "origin": alarm.origin,
        "severity": alarm.severity,
        "state": alarm.state,
        "active": alarm.active,
        "reason": alarm.reason,
        "cause": alarm.cause,
        "opened": format_time(alarm.opened_ns),
        "count": alarm.count,
        "url": f"{url}/alarms/{alarm.number}" if url else "",
    }
