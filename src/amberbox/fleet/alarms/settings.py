"""What admins can set about alarms: when robots that are away are missed, what counts as over."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Final

from amberbox.core.clock import NS

NAME: Final = "alarms"
"""Under this name it is kept among the settings."""


def _check_output(output: str) -> None:
    places = output.split("/")
    if len(places) != 3 or not all(places):
        raise ValueError(f"output: {output!r} is not component/mode/output (* for any)")


@dataclass(frozen=True, slots=True)
class Excuse:
    """A robot that said so last is not missed: an output of a status, and its value.

    ``output`` is ``component/mode/output``; ``*`` in a place fits whatever stands there.
    """

    output: str
    value: bool | float | str = True

    def __post_init__(self) -> None:
        _check_output(self.output)


@dataclass(frozen=True, slots=True)
class Shared:
    """Something that robots share, by an output of their status: its ``word`` is for people."""

    word: str
    output: str

    def __post_init__(self) -> None:
        _check_output(self.output)
        if not self.word.strip():
            raise ValueError("word: say what is shared, for instance 'access point'")


@dataclass(frozen=True, slots=True)
class AlarmSettings:
    """When alarms open, and when they are over; times in seconds.

    A robot that is away for ``offline_after_s`` is missed, 0 is never; ``offline_after_of`` says
    otherwise for a robot or a group. Robots lost within ``together_s`` are one alarm. A new alarm
    waits ``settle_s`` for what it follows from before anybody is told. It is over when it has been
    quiet for ``quiet_s``, and the same alarm again when it comes back within ``reopen_s``. What
    reaches the server more than ``late_s`` after it happened is late.
    """

    offline_after_s: float = 120.0
    offline_after_of: dict[str, float] = field(default_factory=dict)
    together_s: float = 10.0
    settle_s: float = 10.0
    quiet_s: float = 60.0
    reopen_s: float = 300.0
    late_s: float = 60.0
    excused: tuple[Excuse, ...] = (
        Excuse("*/*/docked"), Excuse("*/*/charging"), Excuse("*/*/in_coverage", False),
    )  # fmt: skip
    shared: tuple[Shared, ...] = (Shared("access point", "*/*/access_point"),)

    def __post_init__(self) -> None:
        """Refuse times that are none; raises ValueError."""
        numbers = [(f.name, getattr(self, f.name)) for f in fields(self) if f.name.endswith("_s")]
        for name, value in [*numbers, *self.offline_after_of.items()]:
            if not (math.isfinite(value) and 0 <= value <= 1e7):
                raise ValueError(f"{name}: {value} is no time in seconds")

    def ns(self, name: str) -> int:
        """Return one of the times in nanoseconds: ``ns("quiet_s")``."""
        return round(float(getattr(self, name)) * NS)
