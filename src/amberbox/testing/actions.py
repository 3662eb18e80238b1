"""The context of an action, moved by hand: for tests of kinds of actions and of robots' own."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class ManualContext:
    """A run that must end once ``stop`` is called; keeps what was reported."""

    parameters: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    reports: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._stop = threading.Event()

    def stop(self) -> None:
        """End the run."""
        self._stop.set()

    def stopped(self) -> bool:
        return self._stop.is_set()

    def wait(self, seconds: float) -> bool:
        return self._stop.wait(seconds)

    def report(self, text: str) -> None:
        self.reports.append(text)
