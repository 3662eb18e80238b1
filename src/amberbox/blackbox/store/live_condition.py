"""A condition over recorded variables and statuses, evaluated while they are written."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from amberbox.blackbox.store.tail import follow
from amberbox.core.conditions import ConditionWatcher, WatchedCondition
from amberbox.core.errors import AmberboxError
from amberbox.core.expression import parse
from amberbox.core.types import Batch

_NAME = "condition"
_LOOKBACK_S = 600.0
_POLL_S = 0.5
_AGAIN_S = 30.0


class LiveCondition:
    """Evaluates an expression in a thread; ``value`` is its last known one, None before that."""

    def __init__(self, store: Path, expression: str) -> None:
        self._store, self._text = store, expression
        self._stop = threading.Event()
        self._read_s: float | None = None
        self.value: bool | None = None
        self.problem = ""
        """Why the expression cannot be evaluated."""

    def start(self) -> None:
        """Start the thread, if there is an expression."""
        if self._text:
            name = "live condition"
            threading.Thread(target=self._run, name=name, daemon=True).start()

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()

    def is_true(self, within_s: float) -> bool:
        """Return whether it is true, by data that came in the last seconds."""
        read_s = self._read_s
        is_new = read_s is not None and time.monotonic() - read_s <= within_s
        return is_new and bool(self.value)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._follow()
            except (AmberboxError, OSError) as error:  # the store may appear later, or again
                self.value, self.problem = None, str(error)
            self._stop.wait(_AGAIN_S)

    def _follow(self) -> None:
        conditions = ConditionWatcher({_NAME: WatchedCondition(parse(self._text))})
        batches = follow(
            self._store, conditions.items, None, _LOOKBACK_S, stop=self._stop, poll_s=_POLL_S
        )
        for found in batches:
            if isinstance(found, Batch) and len(found.received_ns):
                conditions.add(found)
                conditions.edges(int(found.received_ns[-1]))
                self.value = _NAME in conditions.true
                self.problem = "; ".join(conditions.problems.values())
                self._read_s = time.monotonic()
