"""Whether the robot is in its dock, as its own record says by an expression."""

from __future__ import annotations

import threading
from pathlib import Path

from amberbox.blackbox.follow.follow import follow
from amberbox.blackbox.keeper.conditions import Condition, Conditions
from amberbox.core.errors import AmberboxError
from amberbox.core.expression import parse
from amberbox.core.types import Batch

_NAME = "docked"
_LOOKBACK_S = 600.0
_POLL_S = 0.5
_AGAIN_S = 30.0


class Dock:
    """Follows what the expression reads, in a thread; ``docked`` is None while nobody knows."""

    def __init__(self, store: Path, expression: str) -> None:
        self._store, self._text = store, expression
        self._stop = threading.Event()
        self.docked: bool | None = None
        self.problem = ""
        """Why the expression cannot be judged."""

    def start(self) -> None:
        """Begin to follow, if there is an expression."""
        if self._text:
            threading.Thread(target=self._run, name="link dock", daemon=True).start()

    def close(self) -> None:
        """Follow no more."""
        self._stop.set()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._follow()
            except (AmberboxError, OSError) as error:  # the store may come later, or come back
                self.docked, self.problem = None, str(error)
            self._stop.wait(_AGAIN_S)

    def _follow(self) -> None:
        conditions = Conditions({_NAME: Condition(parse(self._text))})
        batches = follow(
            self._store, conditions.items, None, _LOOKBACK_S, stop=self._stop, poll_s=_POLL_S
        )
        for found in batches:
            if isinstance(found, Batch) and len(found.received_ns):
                conditions.add(found)
                conditions.edges(int(found.received_ns[-1]))
                self.docked = _NAME in conditions.true
                self.problem = "; ".join(conditions.problems.values())
