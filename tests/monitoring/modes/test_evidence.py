"""No verdict without evidence: modes against a plain reading, with gaps and garbage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input
from amberbox.monitoring.modes import (
    frozen,
    garbage,
    heartbeat,
    range,
    rate_of_change,
    redundancy,
    state_bits,
    working_counter,
)
from amberbox.testing.modes import at_s, one_input
from tests.fuzzing import examples, fuzz

Row = tuple[float, Any]
WINDOW_S = 2.0
RATES_HZ = (2.0, 10.0, 50.0, 1000.0)
VALUES = (0.0, 1.0, 1.0, 5.0, 1e9, np.nan, np.inf, None, "off")


@st.composite
def streams(draw: st.DrawFn) -> list[Row]:
    """Draw rows of a rate over some seconds: steady, with a gap, repeated and late ones."""
    rate_hz, start_s = draw(st.sampled_from(RATES_HZ)), draw(st.sampled_from([0.0, 0.5, 3.0]))
    seconds = draw(st.sampled_from([0.4, 2.5, 4.0])) if rate_hz > 100 else draw(st.floats(0, 12))
    times = np.arange(start_s, start_s + seconds, 1 / rate_hz)
    few = draw(st.lists(st.sampled_from(VALUES), min_size=1, max_size=7))
    values = [few[place % len(few)] for place, _ in enumerate(times)]
    gap_s = draw(st.floats(0, 12)), draw(st.sampled_from([0.0, 0.3, 1.6, 4.0]))
    rows = [
        (round(float(t), 4), value)
        for t, value in zip(times, values, strict=True)
        if not gap_s[0] < t < gap_s[0] + gap_s[1]
    ]
    return [row for row in rows for _ in (0, 1)] if draw(st.integers(0, 9)) == 0 else rows


def made(rows: Sequence[Row]) -> Input:
    return one_input(times_s=[t for t, _ in rows], values=[value for _, value in rows])


def number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else np.nan


def before(rows: Sequence[Row], at: float, seconds: float) -> tuple[list[Row], list[Row]]:
    """Return the last row by the beginning of a window (or none), and those in it."""
    held = [row for row in rows if row[0] <= at - seconds][-1:]
    return held, [row for row in rows if at - seconds < row[0] <= at]


def frozen_evidence(rows: Sequence[Row], at: float, verdict: int) -> bool:
    held, inside = before(rows, at, WINDOW_S)
    good = [row for row in [*held, *inside] if abs(number(row[1])) <= 100]
    if verdict == TRUE:
        return len({number(value) for _, value in good}) > 1
    seen = [max(t, at - WINDOW_S) for t, _ in good]
    gaps = np.diff([at - WINDOW_S, *seen, at])
    return bool(held) and len({value for _, value in good}) == 1 and max(gaps) <= 0.76 * WINDOW_S


def garbage_evidence(rows: Sequence[Row], at: float, verdict: int) -> bool:
    held, inside = before(rows, at, WINDOW_S)
    known = [value for _, value in [*held, *inside] if value is not None]
    bad = [value for value in known if not abs(number(value)) <= 100]
    if verdict == TRUE:
        return bool(held) and len(bad) <= 0.2 * len(known)
    return len(bad) > 0.2 * len(known)


def heartbeat_evidence(rows: Sequence[Row], at: float, verdict: int) -> bool:
    held, inside = before(rows, at, WINDOW_S)
    last = max((t for t, _ in [*held, *inside]), default=None)
    if last is None:
        return False
    is_late = at - last > 1.0
    slow = bool(held) and len(inside) / WINDOW_S < 4.0 * 0.8
    return not is_late if verdict == TRUE else is_late or slow


def changes_evidence(rows: Sequence[Row], at: float, verdict: int) -> bool:
    held, inside = before(rows, at, WINDOW_S)
    last = [*held, *inside][-1:]
    if not held or not np.isfinite([number(held[0][1]), number(last[0][1])]).all():
        return False
    rises = (number(last[0][1]) - number(held[0][1])) / max(WINDOW_S, last[0][0] - held[0][0])
    if verdict == TRUE:
        return rises >= 0.0999
    return rises < 0.1001 and bool(inside)


def in_force(rows: Sequence[Row], at: float, verdict: int) -> bool:
    held, _ = before(rows, at, 0.0)
    return bool(held) and held[0][1] is not None


def word_evidence(rows: Sequence[Row], at: float, verdict: int) -> bool:
    return in_force(rows, at, verdict) and number(before(rows, at, 0.0)[0][0][1]).is_integer()


CASES: Mapping[str, tuple[ModuleType, Any, str, Callable[[Sequence[Row], float, int], bool]]] = {
    "frozen": (
        frozen, frozen.Config(window=WINDOW_S, min=-100, max=100), "moving", frozen_evidence,
    ),
    "garbage": (
        garbage, garbage.Config(window=WINDOW_S, min=-100, max=100, tolerated=20), "clean",
        garbage_evidence,
    ),
    "heartbeat": (
        heartbeat, heartbeat.Config(rate=4, tolerance=20, window=WINDOW_S, max_age=1), "alive",
        heartbeat_evidence,
    ),
    "rate_of_change": (
        rate_of_change, rate_of_change.Config(min=0.1, window=WINDOW_S), "in_limits",
        changes_evidence,
    ),
    "range": (range, range.Config(max=2), "in_range", in_force),
    "state_bits": (state_bits, state_bits.Config({"on": 0}), "ok", word_evidence),
    "working_counter": (
        working_counter, working_counter.Config(expected=1, lasting=WINDOW_S), "complete", in_force,
    ),
}  # fmt: skip


@fuzz
@pytest.mark.parametrize("name", CASES)
def test_a_verdict_has_the_evidence_for_it(name: str) -> None:
    module, config, result, is_evident = CASES[name]

    @settings(max_examples=examples(25))
    @given(rows=streams(), seconds=st.lists(st.integers(0, 64), min_size=1, max_size=8))
    def check(rows: list[Row], seconds: list[int]) -> None:
        instants = [second / 4 for second in sorted(set(seconds))]
        entry = made(rows)
        with np.errstate(all="ignore"):
            each = [module.evaluate(config, [entry], at_s(at))[result] for at in instants]
            many = module.evaluate(config, [entry], np.atleast_1d(at_s(*instants)))[result]
        assert [int(one) for one in each] == [int(one) for one in np.atleast_1d(many)]
        for at, verdict in zip(instants, each, strict=True):
            if int(verdict) not in (UNKNOWN, HOLD):
                assert is_evident(rows, at, int(verdict)), (at, int(verdict), rows[:20])

    check()


def test_redundancy_waits_for_a_full_window_of_each_member() -> None:
    good = [one_input(times_s=[0, 1, 2, 3, 4], values=[1.0] * 5) for _ in "ab"]
    late = one_input(times_s=[2, 3, 4], values=[9.0] * 3)
    config = redundancy.Config(threshold=1.0, window=WINDOW_S)
    found = redundancy.evaluate(config, [*good, late], at_s(1, 2, 3.9, 4))
    assert found["member_1"].tolist() == [UNKNOWN, TRUE, TRUE, TRUE]
    assert found["member_3"].tolist() == [UNKNOWN, UNKNOWN, UNKNOWN, FALSE]


def test_a_rate_over_a_gap_is_that_of_the_gap() -> None:
    entry = one_input(times_s=[0, 1, 2, 62, 63], values=[20.0, 20.0, 20.0, 26.0, 26.0])
    config = rate_of_change.Config(max=1.0, window=WINDOW_S)
    found = rate_of_change.evaluate(config, [entry], at_s(2, 62, 63.5))
    assert found["in_limits"].tolist() == [TRUE, TRUE, TRUE]
    assert found["rate"][1] == pytest.approx(0.1)
    must_rise = rate_of_change.Config(min=0.05, window=WINDOW_S)
    found = rate_of_change.evaluate(must_rise, [entry], at_s(2, 30, 62))
    assert found["in_limits"].tolist() == [FALSE, UNKNOWN, TRUE]


def test_a_count_tells_of_messages_that_a_filter_left_out() -> None:
    flow = one_input(times_s=[0.0], values=[1.0]).flow
    counts = np.array([at_s(second) for second in (1, 2, 3)])
    flow.last_ns.extend(counts, counts - NS // 10)
    assert (flow.received_ns(at_s(0), at_s(2.5)) - at_s(0)).tolist() == [0, NS, 2 * NS]
    assert flow.is_filtered(at_s(2.5)) and not flow.is_filtered(at_s(60))
