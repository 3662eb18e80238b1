"""The status of a robot as a whole: one level, one severity, one sentence, up to when it is known.

Everything that shows how a robot is (cards, heads of pages, diagnosis, lists, metrics, command
line) makes it of ``judge``, so that no two of them can differ.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from amberbox.core.types import Level

Severity: TypeAlias = Literal["warning", "urgent", "critical", "fatal"]
"""What the robot can still do (VDA 5050); ``warning`` makes a level ``warn``, others ``error``."""
Contact: TypeAlias = Literal["online", "silent", "offline", "never"]
"""Of the link: ``silent`` is a connection that holds while its heartbeats are missing."""
Monitoring: TypeAlias = Literal["running", "overloaded", "silent", "absent"]
"""Of the watcher: what is ``overloaded`` speaks of the past, what is ``silent`` said something
before, what is ``absent`` has said nothing yet."""

RANK: Final[Mapping[Level, int]] = {"ok": 0, "warn": 1, "unknown": 2, "stale": 3, "error": 4}
"""How bad a level is."""
WORDS: Final[Mapping[Level, str]] = {
    "ok": "fine", "warn": "warning", "unknown": "unknown", "stale": "stale", "error": "error",
}  # fmt: skip
"""What people read for a level."""
SEVERITIES: Final[tuple[Severity, ...]] = ("warning", "urgent", "critical", "fatal")
"""What the robot can still do, from low to high: the words of VDA 5050 and of the mode files."""
USE: Final[Mapping[Severity, str]] = {
    "warning": "it works",
    "urgent": "it works, see to it soon",
    "critical": "it cannot go on with what it does",
    "fatal": "it must stop and stay stopped",
}
"""What each severity means."""

NOT_MONITORED: Final = "not_monitored"
"""The state of a component that has no monitor: how it is nobody asks."""
NOTHING_WRONG: Final = "Nothing is known to be wrong."
NOTHING_KNOWN: Final = "Nothing is known of it."
_UNHEARD: Final[Mapping[Monitoring, str]] = {
    "silent": "Its watcher is silent.", "absent": "Its watcher has said nothing yet.",
}  # fmt: skip
_DIAGNOSED: Final = "a diagnosis is open"


@dataclass(frozen=True, slots=True)
class Observed:
    """What is known of a robot, of which ``judge`` makes its status.

    ``level`` is the worst of its components, ``reason`` what is worst. ``alarm`` is the highest
    severity of the alarms that last, ``alarm_reason`` what that one is about; alarms that tell of
    its absence are none of them. ``diagnosed``: a diagnosis is open and something of what it
    explains is still seen; ``effect`` is what that leaves of the robot, as far as it is worked
    out. ``as_of`` is when the newest of this was measured, as text (RFC 3339). ``delay_s`` is how
    late overloaded monitoring evaluates.
    """

    contact: Contact = "online"
    monitoring: Monitoring = "running"
    level: Level = "unknown"
    reason: str = ""
    alarm: Severity | Literal[""] = ""
    alarm_reason: str = ""
    diagnosed: bool = False
    effect: Severity | Literal[""] = ""
    as_of: str | None = None
    delay_s: float = 0.0

    @property
    def is_current(self) -> bool:
        """Tell whether anything is known of now."""
        return self.contact == "online" and self.monitoring == "running"


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """How a robot is as a whole.

    ``level`` is ``unknown`` where nothing is known of now; then ``last_level`` is what it was when
    it was last heard of, at ``as_of``. ``severity`` is what it could still do at ``as_of``, empty
    where nothing keeps it from its work. ``text`` says all of this in a sentence, ``reason`` what
    is worst. ``rank`` puts robots in order: the higher, the worse.
    """

    level: Level
    last_level: Level
    severity: Severity | Literal[""]
    text: str
    reason: str
    as_of: str | None
    contact: Contact
    monitoring: Monitoring
    rank: int

    @property
    def is_current(self) -> bool:
        """Tell whether the level is one of now."""
        return self.contact == "online" and self.monitoring == "running"

    @property
    def use(self) -> str:
        """Return what it can still do, with the word for it; empty where nothing is in its way."""
        return use_text(self.severity)

    @property
    def is_trouble(self) -> bool:
        """Tell whether somebody has to see to it, by what is known now or was known last."""
        return self.level in ("warn", "stale", "error") or self.severity != ""


def judge(seen: Observed) -> RobotStatus:
    """Make the one status of a robot of everything that is known of it."""
    severity = highest((seen.alarm, seen.effect))
    last = worst((seen.level, *_floors(seen, severity)))
    level: Level = last if seen.is_current else "unknown"
    return RobotStatus(
        level, last, severity, _text(seen, last, severity), _reason(seen, last), seen.as_of,
        seen.contact, seen.monitoring, _rank(level, last, severity),
    )  # fmt: skip


def worst(levels: Iterable[Level]) -> Level:
    """Return the worst of some levels; ``unknown`` of none."""
    return max(levels, key=RANK.__getitem__, default="unknown")


def components_level(components: Iterable[tuple[Level, str]]) -> Level:
    """Return the worst level of components, each with its state; what has no monitor is left out.

    It is ``unknown`` where nothing is monitored.
    """
    return worst(level for level, state in components if state != NOT_MONITORED)


def highest(severities: Iterable[Severity | Literal[""]]) -> Severity | Literal[""]:
    """Return the highest of some severities; empty of none."""
    return max(severities, key=severity_rank, default="")


def severity_rank(severity: str) -> int:
    """Tell how high a severity is, from 1; 0 for none, and for a word that is none."""
    return SEVERITIES.index(severity) + 1 if severity in SEVERITIES else 0


def use_text(severity: Severity | Literal[""]) -> str:
    """Write a severity for people, with what it means; empty for none."""
    return f"{severity}: {USE[severity]}" if severity else ""


def _floors(seen: Observed, severity: Severity | Literal[""]) -> Iterable[Level]:
    """Yield the levels that it has at least: as monitors make a level of a severity."""
    if severity:
        yield "warn" if severity == "warning" else "error"
    if seen.diagnosed:
        yield "warn"


def _reason(seen: Observed, last: Level) -> str:
    """Name what makes it as it is: a component, else the alarm, else the diagnosis."""
    if last == seen.level and seen.reason:
        return seen.reason
    if seen.alarm and seen.alarm_reason:
        return seen.alarm_reason
    return _DIAGNOSED if seen.diagnosed else seen.reason


def _text(seen: Observed, last: Level, severity: Severity | Literal[""]) -> str:
    if seen.contact == "never":
        return f"{NOTHING_KNOWN} {_capital(use_text(severity))}." if severity else NOTHING_KNOWN
    if not seen.is_current:
        return " ".join(filter(None, (_unheard(seen), _then(last, severity))))
    if severity:
        return f"{_capital(use_text(severity))}."
    return _LEVEL_TEXTS[last]


def _unheard(seen: Observed) -> str:
    """Say why a watcher is not heard whose robot is there; whether that is there is said beside."""
    if seen.contact != "online":
        return ""
    if seen.monitoring == "overloaded":
        return f"Its monitoring is overloaded: what it says comes {seen.delay_s:.0f} s late."
    return _UNHEARD.get(seen.monitoring, "")


def _then(last: Level, severity: Severity | Literal[""]) -> str:
    then = "; ".join(filter(None, (WORDS[last], use_text(severity))))
    return NOTHING_KNOWN if last == "unknown" else f"When it was last heard of: {then}."


_LEVEL_TEXTS: Final[Mapping[Level, str]] = {
    "ok": NOTHING_WRONG,
    "warn": "Something is not as expected.",
    "unknown": "Nobody can tell how all of it is.",
    "stale": "Some of it has stopped saying how it is.",
    "error": "Something of it does not do its work.",
}


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _rank(level: Level, last: Level, severity: Severity | Literal[""]) -> int:
    """Order by the level of now, then by the severity, then by the level that was known last."""
    return (RANK[level] * 10 + severity_rank(severity)) * 10 + RANK[last]
