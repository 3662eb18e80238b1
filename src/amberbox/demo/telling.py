"""Tells the story as it goes: each step with the seconds it took; the first that fails ends it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from amberbox.core.errors import AmberboxError

T = TypeVar("T")

PATIENCE_S = 60.0
"""So long a step waits for what it expects: it takes seconds, unless the machine is very busy."""
_POLL_S = 0.2


class FailedError(AmberboxError):
    """A step did not come to what it should have."""


@dataclass
class Telling:
    """The clock of the story."""

    began_s: float = field(default_factory=time.monotonic)
    steps: int = 0

    def say(self, text: str) -> None:
        """Tell something, with the time since the story began."""
        print(f"[{time.monotonic() - self.began_s:5.1f} s] {text}", flush=True)

    def worked(self, text: str) -> None:
        """Tell that a step worked."""
        self.steps += 1
        self.say(f"ok: {text}")


def until(find: Callable[[], T | None], what: Callable[[], str], within_s: float = PATIENCE_S) -> T:
    """Ask again and again until something is found; raises FailedError when it never is."""
    end_s = time.monotonic() + within_s
    while (found := find()) is None:
        if time.monotonic() > end_s:
            raise FailedError(f"{what()}: waited {within_s:.0f} s in vain", "is the machine busy?")
        time.sleep(_POLL_S)
    return found


def check(fine: bool, what: str) -> None:
    """Raise FailedError unless something is as it should be."""
    if not fine:
        raise FailedError(f"it is not true that {what}", "please report this")
