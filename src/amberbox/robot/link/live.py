"""The latest values of the variables that somebody looks at, never stored on their way."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from amberbox.blackbox.follow.follow import follow
from amberbox.blackbox.store import Store
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Batch

Value = tuple[int, float | str | None]
_LOOKBACK_S = 0.5


class LiveValues:
    """Follows the items of the watched variables in a thread; only while any is watched."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._latest: dict[str, Value] = {}
        self._lock = threading.Lock()
        self._stop: threading.Event | None = None

    def watch(self, variables: Sequence[str]) -> None:
        """Look at these from now on, and at none of before."""
        self.close()
        items = by_item(variables)
        if items:
            self._stop = threading.Event()
            threading.Thread(
                target=self._follow, args=(items, self._stop), name="link live", daemon=True
            ).start()

    def take(self) -> dict[str, Value]:
        """Return what is new since the last call: one value of each variable."""
        with self._lock:
            found, self._latest = self._latest, {}
        return found

    def close(self) -> None:
        """Look at nothing any more."""
        if self._stop is not None:
            self._stop.set()
            self._stop = None
        self.take()

    def _follow(self, items: Mapping[str, Sequence[str]], stop: threading.Event) -> None:
        try:
            for found in follow(self._store.path, items, None, _LOOKBACK_S, stop=stop):
                if stop.is_set():
                    return
                if isinstance(found, Batch):
                    values = dict(latest_of(found, items[found.item]))
                    with self._lock:
                        self._latest.update(values)
        except (AmberboxError, OSError):
            return  # the store is gone: there is nothing to look at; the link itself says so


def by_item(variables: Sequence[str]) -> dict[str, list[str]]:
    """Group addresses ``item.variable`` by item."""
    found: dict[str, list[str]] = {}
    for address in variables:
        item, dot, variable = address.partition(".")
        if dot:
            found.setdefault(item, []).append(variable)
    return found


def latest_of(batch: Batch, variables: Sequence[str]) -> Iterator[tuple[str, Value]]:
    """Give the last value of each variable of a batch, with its time of receipt."""
    at_ns = int(batch.received_ns[-1])
    for variable in variables:
        column = batch.columns.get(variable)
        if isinstance(column, np.ndarray) and column.ndim == 1 and len(column):
            yield f"{batch.item}.{variable}", (at_ns, _plain(column[-1]))


def _plain(value: Any) -> float | str | None:
    """Return a number or text; None for what is unknown or neither."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, str):
        return value[:200]
    return float(value) if isinstance(value, (int, float)) else None
