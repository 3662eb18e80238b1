"""Newest values of a robot's variables and statuses, from a record that is being written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from amberbox.blackbox.store.store import is_locked, is_store, open_store
from amberbox.blackbox.store.tail import RECORDED, follow
from amberbox.core.clock import NS
from amberbox.core.conditions import item_of, value_after
from amberbox.core.expression import Expression, Value, parse
from amberbox.core.names import with_parents
from amberbox.core.types import Batch

LOOKBACK_S = 10.0
"""A value that is older than this counts as unknown."""


_WRITERS = (*RECORDED, "watch")  # the watcher writes the statuses


class LiveValues:
    """What is true of the robot now, by the record at a path.

    Without a running recorder everything is unknown.
    """

    def __init__(self, store: Path) -> None:
        self._store = store

    def __call__(self, address: str) -> Value:
        """Return the newest value of an address; None if it is unknown."""
        return self.value(parse(address), {})

    def value(self, expression: Expression, known: Mapping[str, Value]) -> Value:
        """Return the value of an expression now; names in ``known`` are not of the robot.

        Raises UsageError for values of a wrong type.
        """
        names = [name for name in expression.addresses() if name not in known]
        is_recording = is_store(self._store) and is_locked(open_store(self._store), "main")
        items = {part for name in names for part in with_parents(item_of(name))}
        lookback_s = LOOKBACK_S + expression.history_ns / NS
        batches = (
            follow(self._store, items, None, lookback_s, live=False, writers=_WRITERS)
            if items and is_recording
            else ()
        )
        return value_after(expression, (b for b in batches if isinstance(b, Batch)), known)
