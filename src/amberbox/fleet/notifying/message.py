"""What people read about alarms: subject, text, and the same for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.core.timetext import format_time
from amberbox.fleet.alarms.alarm import Alarm


@dataclass(frozen=True, slots=True)
class Message:
    """A message to one destination; ``key`` is the same at every attempt to deliver it."""

    key: str
    subject: str
    body: str
    data: dict[str, Any] = field(default_factory=dict)


def subject_of(alarm: Alarm) -> str:
    """Return an alarm in a few words: ``critical: ropod_001 laser``."""
    whose = alarm.robot or "several robots:"
    return plain(f"{alarm.severity}: {whose} {alarm.origin}")[:200]


def body_of(alarm: Alarm, url: str, now_ns: int) -> str:
    """Return what is to be said about an alarm."""
    lasts = "it lasts" if alarm.active else "it has ended meanwhile"
    lines = [
        subject_of(alarm),
        plain(alarm.reason),
        *([f"cause: {plain(alarm.cause)}"] if alarm.cause else []),
        f"since {format_time(alarm.opened_ns)[:19]}Z, {lasts}",
        *([f"it came {alarm.count} times"] if alarm.count > 1 else []),
        *(["the robot was offline when it happened"] if alarm.late else []),
        *([f"{url}/alarms/{alarm.number}"] if url else []),
    ]
    return "\n".join(lines)


def data_of(alarm: Alarm, robots: Sequence[str], url: str) -> dict[str, Any]:
    """Return an alarm as programs get it."""
    return {
        "type": "alarm",
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


def plain(text: str) -> str:
    """Take out of a text what is not for reading: line ends and controls, which robots may send."""
    return "".join(char if char.isprintable() else " " for char in text)
