"""Transitions between discrete states, and how long each is stayed in, learnt from nominal runs.

The probability of a transition depends on the time spent in the state (time-variant transitions,
Li and Parker 2009); where little was learnt it falls back to that of the transition at any time,
and then to that of the state that is entered.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.detection.channels import Floats, as_floats

_TIMES_S = np.array([0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0])  # borders of the time in a state
_PRIOR = 1.0
_UNSEEN = 0.5
_STAY_BINS, _STAY_LEAST_S, _STAY_PER_OCTAVE = 100, 0.01, 4
_TAIL = 2.0  # how fast a stay longer than all learnt becomes improbable: a power of its length


class Transitions:
    """Counts of transitions between ``size`` states; a last state stands for all that are new."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._counts = np.zeros((size + 1, size + 1, len(_TIMES_S) + 1))
        self._stays = np.zeros((size + 1, _STAY_BINS))
        self._open = np.zeros((size + 1, _STAY_BINS))
        self._table: Floats | None = None

    def learn(self, before: Floats, now: Floats, spent_s: float) -> None:
        """Count a transition between soft states (size + 1), after so long in the first."""
        self._counts[:, :, _time_bin(spent_s)] += np.outer(before, now)
        self._table = None

    def learn_stay(self, state: int, stay_s: float, complete: bool) -> None:
        """Count a stay; one that the end of a mission cut off is not complete."""
        (self._stays if complete else self._open)[state, _stay_bin(stay_s)] += 1

    def probability(self, before: Floats, now: Floats, spent_s: float) -> float:
        """Return the probability of a transition between soft states."""
        if self._table is None:
            self._table = self._probabilities()
        rows = self._table[:, :, _time_bin(spent_s)]
        return float(((before[:, None] * rows).sum(axis=0) * now).sum())

    def _probabilities(self) -> Floats:
        counts = self._counts
        entered = counts.sum(axis=(0, 2)) + _UNSEEN
        entered /= entered.sum()
        pairs = counts.sum(axis=2) + _PRIOR * entered
        pairs /= pairs.sum(axis=1, keepdims=True)
        table = counts + _PRIOR * pairs[:, :, None]
        return np.asarray(table / table.sum(axis=1, keepdims=True))

    def surprise_of_staying(self, state: int, stay_s: float) -> float:
        """Return -log of the share of learnt stays that were as long.

        A state that was never seen to end has no stay that is too long.
        """
        stays, cut_off = self._stays[state], self._open[state]
        complete = float(stays.sum())
        if complete == 0:
            return 0.0
        where = _stay_bin(stay_s)
        longer = float(stays[where:].sum() + cut_off[where:].sum())
        known = float(complete + cut_off.sum())
        found = -math.log((longer + _UNSEEN) / (known + _UNSEEN))
        longest_s = _stay_of(int(np.flatnonzero(stays + cut_off)[-1]) + 1)
        return found + _TAIL * max(math.log(max(stay_s, 1e-9) / longest_s), 0.0)

    def surprise_of_leaving(self, state: int, stay_s: float) -> float:
        """Return -log of the share of learnt stays that were as short."""
        stays = self._stays[state]
        complete = float(stays.sum())
        shorter = float(stays[: _stay_bin(stay_s) + 1].sum())
        return -math.log((shorter + _UNSEEN) / (complete + _UNSEEN)) if complete else 0.0

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the counts by name; for ``restored``."""
        return {"counts": self._counts, "stays": self._stays, "open": self._open}

    @classmethod
    def restored(cls, arrays: Mapping[str, NDArray[Any]], size: int) -> Transitions:
        """Make what ``arrays`` returned; raises ValueError if it does not fit."""
        made = cls(size)
        made._counts = as_floats(arrays["counts"], made._counts.shape)
        made._stays = as_floats(arrays["stays"], made._stays.shape)
        made._open = as_floats(arrays["open"], made._open.shape)
        if min(made._counts.min(), made._stays.min(), made._open.min()) < 0:
            raise ValueError("a count is negative")
        return made


def _time_bin(spent_s: float) -> int:
    return int(np.searchsorted(_TIMES_S, spent_s, side="right"))


def _stay_bin(stay_s: float) -> int:
    if stay_s <= _STAY_LEAST_S:
        return 0
    return min(int(math.log2(stay_s / _STAY_LEAST_S) * _STAY_PER_OCTAVE), _STAY_BINS - 1)


def _stay_of(border: int) -> float:
    """Return the stay in seconds at which a bin begins."""
    return float(_STAY_LEAST_S * 2 ** (border / _STAY_PER_OCTAVE))
