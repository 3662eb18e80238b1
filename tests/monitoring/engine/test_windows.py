"""Windowed conditions through the engine against a plain reading of every row."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.types import Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import TICK_NS
from amberbox.monitoring.modes import expression
from amberbox.monitoring.plan import MappingPlan, ModePlan
from tests.fuzzing import examples, fuzz
from tests.monitoring.engine.plans import one, output, rows, variable

Row = tuple[int, float]
QUARTER_NS = NS // 4
SECONDS = 5
FUNCTIONS = ("min", "max", "mean", "std", "count", "rate")


def reduced(name: str, inside: Sequence[Row]) -> float | None:
    """Return a function of the rows of one window, None where there are too few."""
    values = [value for _, value in inside]
    if name == "count":
        return len(values)
    if name == "rate":
        elapsed_s = (inside[-1][0] - inside[0][0]) / NS if len(inside) > 1 else 0.0
        return (values[-1] - values[0]) / elapsed_s if elapsed_s else None
    if not values:
        return None
    means: dict[str, Any] = {
        "mean": statistics.fmean,
        "std": statistics.pstdev,
        "min": min,
        "max": max,
    }
    return float(means[name](values))


def expected_of(
    record: Sequence[Row], name: str, window_ns: int, limit: float
) -> list[tuple[int, str]]:
    """Return when the level changes: looked at every quarter, and with each row where short."""
    ticks = [-(-at // TICK_NS) * TICK_NS for at, _ in record]
    instants = set(range(QUARTER_NS, SECONDS * NS + 1, QUARTER_NS)) | set(ticks[:1])
    instants |= set(ticks) if window_ns < NS // 2 else set()
    found = [(0, "unknown")]
    for now in sorted(at for at in instants if at <= SECONDS * NS):
        inside = [row for row in record if now - window_ns < row[0] <= now]
        value = reduced(name, inside) if record and record[0][0] <= now else None
        level = "unknown" if value is None else "ok" if value < limit else "error"
        if level != found[-1][1]:
            found.append((now, level))
    return found


@st.composite
def records(draw: st.DrawFn) -> list[Row]:
    """Draw rows at up to 1 kHz: bursts, gaps, several at one time, a value out of line."""
    period_ms = draw(st.sampled_from([1, 2, 7, 20, 100, 300, 500]))
    count = draw(st.integers(0, min(150, 4500 // period_ms)))
    start, gap = draw(st.integers(1, 1500)), draw(st.integers(0, 2000))
    jitter = draw(st.lists(st.integers(0, period_ms // 2), min_size=1, max_size=5))
    place = draw(st.integers(0, 150))
    times = [
        start + k * period_ms + jitter[k % len(jitter)] + (gap if k > place else 0)
        for k in range(count)
    ]
    high = draw(st.sampled_from([1.0, 50.0, 1000.0]))
    steps = draw(st.booleans())
    return [
        (at * 10**6, high if k == place or (steps and k > place) else 0.5 * (k % 2))
        for k, at in enumerate(sorted(times))
    ]


def levels(record: Sequence[Row], condition: str, cuts: Sequence[int]) -> list[tuple[int, str]]:
    """Return the times at which the level of a mode changes, for rows in batches cut at given
    times.
    """
    wanted = output(expression.RESULTS[0], flaps=10**6)
    mapping = MappingPlan([], [wanted], [variable()])
    config = expression.Config(condition=parse(condition))
    engine = Engine(one(ModePlan("m", "m", expression, config, [mapping], stale_s=None)))
    engine.begin(0)
    findings, left = [], list(record)
    for until_ns in sorted({*cuts, SECONDS * NS}):
        part = [row for row in left if row[0] <= until_ns]
        left = left[len(part) :]
        for some in (part[: len(part) // 2], part[len(part) // 2 :]):
            if some:
                engine.feed(rows([at for at, _ in some], v=np.array([v for _, v in some])))
        findings += engine.advance(until_ns)
    statuses = [each for each in findings if isinstance(each, Status) and each.mode == "m"]
    found = [(status.since_ns, status.level) for status in statuses]
    return [at for n, at in enumerate(found) if not n or at[1] != found[n - 1][1]]


@fuzz
@settings(max_examples=examples(50))
@given(
    record=records(), name=st.sampled_from(FUNCTIONS), window_ms=st.integers(100, 3000),
    limit=st.sampled_from([0.3, 0.7, 3.0, 40.0]), data=st.data(),
)  # fmt: skip
def test_every_window_is_that_of_the_rows(
    record: list[Row], name: str, window_ms: int, limit: float, data: Any
) -> None:
    cuts = data.draw(st.lists(st.integers(0, SECONDS * 20), max_size=6))
    condition = f"{name}(a.v over {window_ms}ms) < {limit}"
    found = levels(record, condition, [cut * TICK_NS for cut in cuts])
    expected = expected_of(record, name, window_ms * 10**6, limit)
    assert [level for _, level in found] == [level for _, level in expected]
    assert [at for at, _ in found[1:]] == [at for at, _ in expected[1:]]


@fuzz
@settings(max_examples=examples(25))
@given(record=records(), window_ms=st.integers(100, 3000), data=st.data())
def test_every_row_is_in_some_window(record: list[Row], window_ms: int, data: Any) -> None:
    whole = [row for row in record if row[0] < (SECONDS - 1) * NS]
    cuts = data.draw(st.lists(st.integers(0, SECONDS * 20), max_size=6))
    limit = math.nextafter(max((value for _, value in whole), default=0.0), 0.0)
    lowest = any(value == 0.0 for _, value in whole)
    for name, word, is_seen in (("max", f"< {limit!r}", bool(whole)), ("min", "> 0.0", lowest)):
        condition = f"{name}(a.v over {window_ms}ms) {word}"
        found = levels(whole, condition, [cut * TICK_NS for cut in cuts])
        assert ("error" in {level for _, level in found}) == is_seen
