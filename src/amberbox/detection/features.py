"""Features of a sliding window: mean, standard deviation, largest jump and range of each channel.

Windows are cut by time of arrival, so that messages may come at any rate and from many items.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from amberbox.core.contracts import Row
from amberbox.detection.channels import Channels, Floats, add_count, as_floats

NAMES = ("mean", "deviation", "jump", "range")
_MOST_ROWS = 4000
_SILENT = 3.0  # times the longest learnt gap, after which an item has no features


class Window:
    """The messages of the last ``length_ns`` nanoseconds, of all items of ``channels``."""

    def __init__(self, channels: Channels, length_ns: int, longest_ns: Mapping[str, int]) -> None:
        self.channels = channels
        self._length_ns = length_ns
        self._longest_ns = longest_ns
        self._rows: dict[str, list[tuple[int, Floats]]] = {}
        self._before: dict[str, tuple[int, Floats]] = {}

    def add(self, row: Row, counts: dict[str, int]) -> None:
        """Add a message; a value that is not finite stays as it was."""
        scaled = self.channels.scaled(row, counts)
        if scaled is None:
            return
        _, values = scaled
        rows = self._rows.setdefault(row.item, [])
        unknown = np.isnan(values)
        if unknown.any():
            newest = rows[-1] if rows else self._before.get(row.item)
            values = np.where(unknown, 0.0 if newest is None else newest[1], values)
        if len(rows) >= _MOST_ROWS:
            add_count(counts, f"messages beyond {_MOST_ROWS} of an item in a window")
            self._before[row.item] = rows.pop(0)
        rows.append((row.at_ns, values))

    def features(self, now_ns: int) -> Floats | None:
        """Return mean, deviation, jump and range of each channel: n times 4 numbers.

        Those of an item without messages in the window are what it said last, and 0 once it is
        silent for long. None if no item has any in the window.
        """
        found = np.zeros((len(self.channels), len(NAMES)))
        has_news = False
        for item, own in self.channels.items.items():
            rows = self._rows.get(item, [])
            old = 0
            while old < len(rows) and rows[old][0] < now_ns - self._length_ns:
                old += 1
            if old:
                self._before[item] = rows[old - 1]
                del rows[:old]
            before = self._before.get(item)
            if rows:
                has_news = True
                found[own.where] = _features(rows, before)
            elif before is not None:
                patience_ns = max(self._longest_ns.get(item, 0) * _SILENT, self._length_ns)
                if now_ns - before[0] <= patience_ns:
                    found[own.where, 0] = before[1]
        return found.ravel() if has_news else None

    def snapshot(self) -> dict[str, Any]:
        """Return all messages held, as JSON."""
        return {
            "rows": {
                item: [(at, v.tolist()) for at, v in rows] for item, rows in self._rows.items()
            },
            "before": {item: (at, v.tolist()) for item, (at, v) in self._before.items()},
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Restore what ``snapshot`` returned."""
        sizes = {item: (len(own.variables),) for item, own in self.channels.items.items()}

        def read(item: str, row: Any) -> tuple[int, Floats]:
            return int(row[0]), as_floats(np.array(row[1], float), sizes[item])

        self._rows = {i: [read(i, row) for row in rows] for i, rows in snapshot["rows"].items()}
        self._before = {item: read(item, row) for item, row in snapshot["before"].items()}


def _features(rows: list[tuple[int, Floats]], before: tuple[int, Floats] | None) -> Floats:
    """Return the features of the messages (n, 4); the jump counts the one before them as well."""
    values = np.array([row[1] for row in rows])
    all_of_them = values if before is None else np.concatenate([before[1][None, :], values])
    found = np.zeros((values.shape[1], len(NAMES)))
    found[:, 0] = values.mean(axis=0)
    found[:, 1] = values.std(axis=0)
    if len(all_of_them) > 1:
        found[:, 2] = np.abs(all_of_them[1:] - all_of_them[:-1]).max(axis=0)
    found[:, 3] = values.max(axis=0) - values.min(axis=0)
    return found
