"""The detectors' scores for modes: new rows of their journal, as the watcher records them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from amberbox.blackbox.store.derived_journal import ItemMessage
from amberbox.blackbox.store.store import Store
from amberbox.blackbox.store.tail import RecordFollower
from amberbox.core.clock import NS
from amberbox.core.detector_items import WRITER, copied_from, copied_item
from amberbox.core.types import Batch

_LATEST_NS = 5 * NS
"""Older scores, of detectors that are catching up, are not news of now."""
_LOOKBACK_S = 1e-3
_SOURCE = "watch"


class DetectorScores:
    """Reads the items of detectors that ``items`` are copies of."""

    def __init__(self, store: Store, items: Collection[str]) -> None:
        wanted = {name for item in items if (name := copied_from(item))}
        self._follower = (
            RecordFollower(store.path, wanted, lookback_s=_LOOKBACK_S, writers=(WRITER,))
            if wanted
            else None
        )
        self._until_ns: dict[str, int] = {}

    def take(self, now_ns: int) -> Iterator[ItemMessage]:
        """Yield the rows since the last call, without those of long before a log time (ns)."""
        for delivery in self._follower.step() if self._follower is not None else ():
            if isinstance(delivery, Batch):
                yield from self._rows(delivery, now_ns)

    def _rows(self, batch: Batch, now_ns: int) -> Iterator[ItemMessage]:
        name = copied_item(batch.item)
        for row in range(len(batch)):
            values = {key: _plain(column[row]) for key, column in batch.columns.items()}
            at_ns = values.get("at_ns")
            if not isinstance(at_ns, int) or not now_ns - _LATEST_NS < at_ns <= now_ns:
                continue
            if at_ns > self._until_ns.get(name, 0):
                self._until_ns[name] = at_ns
                yield ItemMessage(f"{_SOURCE}/{batch.item}", name, _SOURCE, values)


def _plain(value: Any) -> Any:
    if value is np.ma.masked:
        return None
    return value.item() if isinstance(value, np.generic) else value
