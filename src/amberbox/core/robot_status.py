"""The status of a robot as a whole: one level, one severity, one sentence, up to when it is known.

All displays of a robot's status (cards, page heads, diagnosis, lists, metrics, command line) use
``judge``, so that they cannot differ.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, TypeAlias

from amberbox.core.types import Later, Level, Missing

# what the robot can still do (VDA 5050); ``warning`` gives level ``warn``, others ``error``
Severity: TypeAlias = Literal["warning", "urgent", "critical", "fatal"]
# of the link; ``silent`` is connected without heartbeats
Contact: TypeAlias = Literal["online", "silent", "offline", "never"]
# Of the watcher: an ``overloaded`` one evaluates late, a ``silent`` one has reported before, an
# ``absent`` one never.
Monitoring: TypeAlias = Literal["running", "overloaded", "silent", "absent"]

# the higher, the worse
RANK: Final[Mapping[Level, int]] = {"ok": 0, "warn": 1, "unknown": 2, "stale": 3, "error": 4}
# levels as people read them
WORDS: Final[Mapping[Level, str]] = {
    "ok": "fine", "warn": "warning", "unknown": "unknown", "stale": "stale", "error": "error",
}  # fmt: skip
# from low to high, the words of VDA 5050 and of mode files
SEVERITIES: Final[tuple[Severity, ...]] = ("warning", "urgent", "critical", "fatal")
# what each severity means
USE: Final[Mapping[Severity, str]] = {
    "warning": "it works",
    "urgent": "it works, see to it soon",
    "critical": "it cannot go on with what it does",
    "fatal": "it must stop and stay stopped",
}

NOT_MONITORED: Final = "not_monitored"  # state of a component without a monitor
NOTHING_WRONG: Final = "Nothing is known to be wrong."
NOTHING_KNOWN: Final = "Nothing is known of it."
_SILENCE_TEXTS: Final[Mapping[Monitoring, str]] = {
    "silent": "Its watcher is silent.", "absent": "Its watcher has said nothing yet.",
}  # fmt: skip
_DIAGNOSED: Final = "a diagnosis is open"


@dataclass(frozen=True, slots=True)
class Observed:
    """The facts about a robot from which ``judge`` derives its status.

    ``level`` is the worst of its components, ``reason`` that of the worst one. ``alarm`` is the
    highest severity of the active alarms, ``alarm_reason`` the reason of that one; alarms about its
    absence do not count. ``diagnosed``: a diagnosis is open and at least one of its symptoms is
    still present; ``effect`` is its effect on the robot, as far as it is known. ``as_of`` is when
    the newest of these was measured, as text (RFC 3339). ``delay_s`` is the delay of overloaded
    monitoring.
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
        """Return whether the present status is known."""
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
    last_level: Annotated[Level, Missing("unknown")]
    severity: Later[Severity | Literal[""]]
    text: Later[str]
    reason: Later[str]
    as_of: Later[str | None]
    contact: Later[Contact]
    monitoring: Later[Monitoring]
    rank: Later[int]

    @property
    def is_current(self) -> bool:
        """Return whether the level is one of now."""
        return self.contact == "online" and self.monitoring == "running"

    @property
    def use(self) -> str:
        """Return the severity with its meaning; empty where nothing limits the robot."""
        return use_text(self.severity)

    @property
    def is_trouble(self) -> bool:
        """Return whether it needs attention, by its present or last known level."""
        return self.level in ("warn", "stale", "error") or self.severity != ""


def judge(seen: Observed) -> RobotStatus:
    """Return the status of a robot from everything that is known about it."""
    severity = highest((seen.alarm, seen.effect))
    last = worst((seen.level, *_floors(seen, severity)))
    level: Level = last if seen.is_current else "unknown"
    # Ordered by the level now, then the severity, then the level that was known last.
    rank = (RANK[level] * 10 + severity_rank(severity)) * 10 + RANK[last]
    return RobotStatus(
        level, last, severity, _text(seen, last, severity), _reason(seen, last), seen.as_of,
        seen.contact, seen.monitoring, rank,
    )  # fmt: skip


def worst(levels: Iterable[Level]) -> Level:
    """Return the worst of some levels; ``unknown`` of none."""
    return max(levels, key=RANK.__getitem__, default="unknown")


def components_level(components: Iterable[tuple[Level, str]]) -> Level:
    """Return the worst level of components, each with its state; those without a monitor are left
    out.

    It is ``unknown`` if nothing is monitored.
    """
    return worst(level for level, state in components if state != NOT_MONITORED)


def highest(severities: Iterable[Severity | Literal[""]]) -> Severity | Literal[""]:
    """Return the highest of some severities; empty of none."""
    return max(severities, key=severity_rank, default="")


def severity_rank(severity: str) -> int:
    """Return how high a severity is, from 1; 0 for none, and for a word that is none."""
    return SEVERITIES.index(severity) + 1 if severity in SEVERITIES else 0


def use_text(severity: Severity | Literal[""]) -> str:
    """Return a severity with its meaning as text; empty for none."""
    return f"{severity}: {USE[severity]}" if severity else ""


def _floors(seen: Observed, severity: Severity | Literal[""]) -> Iterable[Level]:
    """Yield lower bounds of the level, from severities as monitors do."""
    if severity:
        yield "warn" if severity == "warning" else "error"
    if seen.diagnosed:
        yield "warn"


def _reason(seen: Observed, last: Level) -> str:
    """Return the reason of the status: a component, else the alarm, else the diagnosis."""
    if last == seen.level and seen.reason:
        return seen.reason
    if seen.alarm and seen.alarm_reason:
        return seen.alarm_reason
    return _DIAGNOSED if seen.diagnosed else seen.reason


def _text(seen: Observed, last: Level, severity: Severity | Literal[""]) -> str:
    if seen.contact == "never":
        return f"{NOTHING_KNOWN} {_capital(use_text(severity))}." if severity else NOTHING_KNOWN
    if not seen.is_current:
        return " ".join(filter(None, (_silence_text(seen), _last_known_text(last, severity))))
    if severity:
        return f"{_capital(use_text(severity))}."
    return _LEVEL_TEXTS[last]


def _silence_text(seen: Observed) -> str:
    """Return why a robot that is online has no current monitoring."""
    if seen.contact != "online":
        return ""
    if seen.monitoring == "overloaded":
        return f"Its monitoring is overloaded: what it says comes {seen.delay_s:.0f} s late."
    return _SILENCE_TEXTS.get(seen.monitoring, "")


def _last_known_text(last: Level, severity: Severity | Literal[""]) -> str:
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
