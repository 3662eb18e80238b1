"""Records of robots as they are shown: what does not have this form is passed over.

A robot may send anything. Nothing that it says can break an answer that is about others, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeVar

import msgspec

from amberbox.core.clock import NS
from amberbox.core.robotstatus import RANK
from amberbox.core.timetext import format_time
from amberbox.core.types import Level

_RANKS: Mapping[str, int] = dict(RANK.items())
_FIRST_NS, _BEYOND_NS = 1, 2**63
LONGEST = 256 << 10
"""Bytes of a record that is shown: what is remembered of a robot has an end."""
Kind = TypeVar("Kind", bound=msgspec.Struct)


class SaidOutput(msgspec.Struct, frozen=True):
    """One output of a mode."""

    name: str
    type: str = "null"
    value: float | None = None
    text: str | None = None

    @property
    def shown(self) -> bool | int | float | str | None:
        """Return the value; not-a-number and infinity are words."""
        if self.value is None:
            return self.text
        if self.type == "bool":
            return bool(self.value)
        return int(self.value) if self.type == "int" else self.value


class SaidStatus(msgspec.Struct, frozen=True):
    """One status."""

    component: str
    mode: str = ""
    level: str = "unknown"
    state: str = ""
    outputs: list[SaidOutput] = []
    blocked_by: list[str] = []
    measured_ns: int = 0
    since_ns: int = 0
    reason: str = ""

    @property
    def rank(self) -> int:
        """Return how bad it is."""
        return rank_of(self.level)

    @property
    def known_level(self) -> Level:
        """Return the level; ``unknown`` for a word that is none."""
        return self.level if self.level in RANK else "unknown"  # type: ignore[return-value]  # it is one of them


class SaidMission(msgspec.Struct, frozen=True):
    """The beginning or the end of a mission."""

    id: str
    name: str = ""
    state: str = ""
    outcome: str = ""
    from_ns: int = 0
    to_ns: int | None = None


class SaidHypothesis(msgspec.Struct, frozen=True):
    """One answer of a diagnosis."""

    faults: list[str] = []
    probability: float = 0.0


class SaidDiagnosis(msgspec.Struct, frozen=True):
    """A diagnosis, as far as cards show it."""

    id: str
    revision: int = 0
    at_ns: int = 0
    state: str = ""
    hypotheses: list[SaidHypothesis] = []
    symptoms: list[str] = []


class SaidSymptom(msgspec.Struct, frozen=True):
    """A symptom, as far as it tells whether it is there."""

    id: str
    state: str = ""
    onset_ns: int | None = None
    confirmed_ns: int | None = None


class SaidEvent(msgspec.Struct, frozen=True):
    """An event; ``details`` is JSON."""

    kind: str = ""
    text: str = ""
    source: str = ""
    details: str = ""


class SaidCondition(msgspec.Struct, frozen=True):
    """Level and state."""

    level: str = "unknown"
    state: str = ""


class SaidTransition(msgspec.Struct, frozen=True):
    """The details of an event of kind ``component_state``."""

    component: str
    mode: str = ""
    before: SaidCondition = SaidCondition()
    after: SaidCondition = SaidCondition()
    at_ns: int = 0
    reason: str = ""


def rank_of(level: str) -> int:
    """Return how bad a level is; any text may come."""
    return _RANKS.get(level, RANK["unknown"])


def heard(data: bytes | str, kind: type[Kind]) -> Kind | None:
    """Read a record; None where it does not have the form, or is too long to look at."""
    if len(data) > LONGEST:
        return None
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def taken(values: Any, kind: type[Kind]) -> Kind | None:
    """Read a record that is decoded already; None where it does not have the form."""
    try:
        return msgspec.convert(values, kind, strict=False)
    except (msgspec.MsgspecError, ValueError):
        return None


def moment(time_ns: int | None) -> str | None:
    """Write a time; None for none, and for a number that is no time."""
    if time_ns is None or not _FIRST_NS <= time_ns < _BEYOND_NS:
        return None
    seconds, rest_ns = divmod(time_ns, NS)
    return f"{_second(seconds)}.{rest_ns:09}Z"


@lru_cache(maxsize=4096)
def _second(seconds: int) -> str:
    """Write a whole second; statuses of one moment share it."""
    return format_time(seconds * NS).partition(".")[0]


def status_data(said: SaidStatus) -> Mapping[str, Any]:
    """Return a status as it is sent; times by the robot's clock."""
    return {
        "component": said.component,
        "mode": said.mode,
        "level": said.level,
        "state": said.state,
        "reason": said.reason,
        "blocked_by": said.blocked_by,
        "measured": moment(said.measured_ns),
        "since": moment(said.since_ns),
        "outputs": {output.name: output.shown for output in said.outputs},
    }
