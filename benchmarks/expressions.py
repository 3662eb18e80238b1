"""What one look at a condition costs, as live monitors look: at one instant, over samples held."""

from __future__ import annotations

import time

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.samples import Samples
from benchmarks.common import Row

LOOKS = 300
SECONDS = 30
RATE_HZ = 100
TARGETS_US = {
    "x.a > 3 and not (x.b < 0.85 * x.c)": 40,
    "x.mode != 'charge' or x.a > 0": 40,
    "mean(x.a over 2s) > 0.8": 120,
    "abs(mean((x.a + x.b) * 0.6 + x.c over 15s)) < 0.12": 120,
    "std(x.a + x.b over 3s) < 0.2 and std(x.b + x.c over 3s) < 0.2": 120,
    "abs(x.a) < 100 for 2s": 120,
    "x.mode == 'ride' for 2s": 120,
}


def measure() -> list[Row]:
    """Look at each condition many times; the best of several turns counts."""
    samples = _samples()
    return [_look(text, samples, target_us) for text, target_us in TARGETS_US.items()]


def _samples() -> dict[str, Samples]:
    count = SECONDS * RATE_HZ
    times_ns = np.arange(count, dtype=np.int64) * (NS // RATE_HZ)
    random = np.random.default_rng(1)
    found = {name: Samples() for name in ("x.a", "x.b", "x.c", "x.mode")}
    for name in ("x.a", "x.b", "x.c"):
        found[name].extend(times_ns, random.normal(size=count))
    found["x.mode"].extend(times_ns[::10], np.array(["ride"] * (count // 10), object))
    return found


def _look(text: str, samples: dict[str, Samples], target_us: float) -> Row:
    expression, now = parse(text), (SECONDS - 1) * NS
    turns_us = []
    for _ in range(7):
        begin_s = time.process_time()
        for _ in range(LOOKS):
            expression.evaluate_samples(samples, now)
        turns_us.append((time.process_time() - begin_s) / LOOKS * 1e6)
    return Row(f"one look: {text}", min(turns_us), "us", note=f"target: {target_us}")
