"""The rate of a topic, learned from the times at which its messages were received."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amberbox.core.clock import NS

FEWEST = 5  # messages from which a rate can be learned
WINDOW_S = 5.0  # of the heartbeats that will judge the rate
_WINDOW_PERIODS = 4.0
_QUANTILE = 0.05
_LONGEST_GAP = 3.0  # mean intervals between two messages of a steady topic, or
_HICCUP_S = 0.5  # this, on a busy computer
_FEW, _MOST_SPREAD = 50, 0.8  # of few messages the intervals must not vary like those of events


@dataclass(frozen=True, slots=True)
class LearnedRate:
    """How often messages came: on average, and in the slowest windows of all (Hz)."""

    mean_hz: float
    low_hz: float
    longest_gap_s: float


def learn_rate(received_ns: Sequence[int], until_ns: int) -> LearnedRate | None:
    """Return the rate of a steady topic; None for few messages, events, and what has stopped.

    ``until_ns`` is when listening ended. The low rate is the 5 % quantile over windows as long as
    those of a heartbeat.
    """
    if len(received_ns) < FEWEST:
        return None
    times_s = (np.asarray(received_ns, np.int64) - received_ns[0]) / NS
    length_s = max((until_ns - received_ns[0]) / NS, float(times_s[-1]))
    gaps_s = np.diff(times_s)
    if not gaps_s.any():
        return None
    mean_hz = len(gaps_s) / float(times_s[-1])
    longest_s = max(float(gaps_s.max()), length_s - float(times_s[-1]))
    if longest_s > max(_LONGEST_GAP / mean_hz, _HICCUP_S):
        return None
    if len(gaps_s) < _FEW and gaps_s.std() > _MOST_SPREAD * gaps_s.mean():
        return None
    window_s = max(WINDOW_S, _WINDOW_PERIODS / mean_hz)
    starts_s = times_s[times_s + window_s <= length_s]
    counts = times_s.searchsorted(starts_s + window_s) - times_s.searchsorted(starts_s)
    low_hz = float(np.quantile(counts, _QUANTILE)) / window_s if len(counts) else mean_hz
    return LearnedRate(mean_hz, min(low_hz, mean_hz), longest_s)
