"""Runs declared actions in tests: by their declaration, in a thread, with a context."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amberbox.experiments.action import DeclaredAction, load_action
from amberbox.testing.actions import ManualContext


def declared(folder: Path, text: str) -> DeclaredAction:
    """Declare one action, ``act``, in a robot folder and read it."""
    (folder / "actions").mkdir(exist_ok=True)
    lines = "".join(f"  {line}\n" for line in text.strip().splitlines())
    (folder / "actions" / "act.yaml").write_text(f"act:\n{lines}")
    return load_action(folder, "act")


@dataclass
class BackgroundRun:
    """A run in a thread of its own, with what it returned or raised."""

    action: DeclaredAction
    context: ManualContext
    result: Any = None
    error: Exception | None = None
    ended_s: float = 0.0

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.result = self.action.module.run(self.action.config, self.context)
        except Exception as error:
            self.error = error
        self.ended_s = time.monotonic()

    @property
    def is_running(self) -> bool:
        """Return whether the run has not ended."""
        return self._thread.is_alive()

    def join(self, seconds: float = 60.0) -> Any:
        """Wait for the end and return the result, or raise what was raised."""
        self._thread.join(seconds)
        assert not self._thread.is_alive(), "the run has not ended"
        if self.error is not None:
            raise self.error
        return self.result


def timed(work: Callable[[], Any]) -> float:
    """Return how long a call takes, in seconds."""
    began_s = time.monotonic()
    work()
    return time.monotonic() - began_s
