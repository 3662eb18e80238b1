"""The engine: findings do not depend on batches, and nothing stays green without data."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.types import Batch, Level, Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.findings import TICK_NS, Finding, encoded
from amberbox.monitoring.modes import expression
from amberbox.monitoring.plan import InputPlan, MappingPlan, ModePlan
from tests.monitoring.engine.plans import (
    ALIVE,
    CRASHING,
    POSITIVE,
    POSITIVE_SLOWLY,
    STEADY,
    VALUE,
    WORD,
    counts,
    gap,
    mode,
    mode_module,
    one,
    output,
    rows,
    seconds,
    variable,
)


def watch(modes: Sequence[ModePlan], batches: Sequence[Batch], until_s: float) -> list[Finding]:
    engine = Engine(one(*modes))
    engine.begin(0)
    for batch in batches:
        engine.feed(batch)
    return engine.advance(round(until_s * NS))


def levels(findings: Sequence[Finding], name: str = "m") -> list[tuple[float, Level]]:
    """Return the levels of a mode and since when, each once."""
    found: list[tuple[float, Level]] = []
    for status in findings:
        if isinstance(status, Status) and status.mode == name:
            entry = (status.since_ns / NS, status.level)
            if not found or found[-1] != entry:
                found.append(entry)
    return found


def test_an_instant_comes_after_the_row_that_it_is_about() -> None:
    batch = rows(seconds(1.0, 1.01, 2.0), v=[1.0, -2.0, 1.0])
    found = levels(watch([mode(POSITIVE, variable())], [batch], 3.0))
    assert found == [(0.0, "unknown"), (1.0, "ok"), (1.05, "error"), (2.0, "ok")]


def test_between_the_limits_it_stays_as_it_was() -> None:
    batch = rows(seconds(1, 2, 3, 4, 5), v=[-0.5, -2.0, -0.5, 1.0, -0.5])
    found = levels(watch([mode(POSITIVE, variable())], [batch], 6.0))
    assert found == [(0.0, "unknown"), (1.0, "ok"), (2.0, "error"), (4.0, "ok")]


def test_what_depends_on_time_changes_without_a_row() -> None:
    batch = rows(seconds(1.0), v=[5.0])
    found = levels(watch([mode(STEADY, variable())], [batch], 3.0))
    assert found == [(0.0, "unknown"), (1.0, "error"), (2.0, "ok")]


@settings(max_examples=60)
@given(
    period_ms=st.integers(20, 600), phase_ms=st.integers(0, 1000), place=st.integers(1, 8),
    spare_ms=st.integers(0, 200), word=st.sampled_from(["rate", "max"]),
)  # fmt: skip
def test_no_jump_falls_between_two_windows(
    period_ms: int, phase_ms: int, place: int, spare_ms: int, word: str
) -> None:
    """A window of two periods sees every sample together with the one before it, at any instant."""
    window_ms = max(2 * period_ms, 100) + spare_ms
    times = np.arange(10, dtype=np.int64) * period_ms * 10**6 + (1000 + phase_ms) * 10**6
    if word == "rate":
        values, condition = (np.arange(10) >= place) * 1000.0, f"rate(a.v over {window_ms}ms) < 1"
    else:
        values, condition = (np.arange(10) == place) * 1.0, f"max(a.v over {window_ms}ms) < 1"
    config = expression.Config(condition=parse(condition))
    mapping = MappingPlan([], [output(expression.RESULTS[0])], [variable()])
    plan = ModePlan("m", "m", expression, config, [mapping], stale_s=None)
    found = levels(watch([plan], [rows(times, v=values)], 10.0))
    assert "error" in {level for _, level in found}


def test_a_value_gets_stale() -> None:
    batch = rows(seconds(1.0), v=[1.0])
    findings = watch([mode(POSITIVE, variable(), stale_s=2.0)], [batch], 5.0)
    assert levels(findings) == [(0.0, "unknown"), (1.0, "ok"), (3.25, "stale")]
    last = [f for f in findings if isinstance(f, Status) and f.mode == "m"][-1]
    assert last.reason == "nothing received of a.v for 2 s"
    assert last.outputs == {"good": None, "value": None}


def test_counted_messages_keep_a_filtered_value_fresh() -> None:
    counted = counts(seconds(1, 2, 3, 4), [10, 20, 30, 30], seconds(1, 2, 3, 3))
    batches = [rows(seconds(1.0), v=[1.0]), counted]
    found = levels(watch([mode(POSITIVE, variable(), stale_s=1.5)], batches, 6.0))
    assert found == [(0.0, "unknown"), (1.0, "ok"), (4.75, "stale")]


def test_a_lost_publisher_is_told_after_a_second() -> None:
    batches = [rows(seconds(1.0, 4.0), v=[1.0, 1.0]), gap(2 * NS, 2 * NS, None)]
    batches.append(gap(4 * NS, 2 * NS, 4 * NS))
    findings = watch([mode(POSITIVE, variable(), stale_s=None)], batches, 5.0)
    assert levels(findings) == [(0.0, "unknown"), (1.0, "ok"), (3.0, "stale"), (4.0, "ok")]
    reasons = {f.reason for f in findings if isinstance(f, Status) and f.level == "stale"}
    assert "the publisher of a.v is lost: lost" in reasons


def test_another_publisher_of_the_same_keeps_it_fresh() -> None:
    batches = [rows(seconds(1.0, 2.1, 3.0), v=[1.0] * 3), gap(2 * NS, 2 * NS, None)]
    found = levels(watch([mode(POSITIVE, variable(), stale_s=None)], batches, 3.0))
    assert found == [(0.0, "unknown"), (1.0, "ok")]


def test_when_both_publishers_are_lost_the_later_one_counts() -> None:
    """The first has been lost for long when the second is lost: its earlier messages are past."""
    batches = [
        rows(seconds(1.0, 2.5, 3.5), v=[1.0] * 3),
        gap(2 * NS, 2 * NS, None),
        gap(4 * NS, 4 * NS, None),
    ]
    monitored = mode(POSITIVE, variable(), stale_s=None)
    assert levels(watch([monitored], batches, 5.0))[-1] == (5.0, "stale")


def test_lost_publishers_are_remembered() -> None:
    """Two are lost before the snapshot; one comes back after it without sending."""
    plan = one(mode(POSITIVE, variable(), stale_s=None))
    first, resumed = Engine(plan), Engine(plan)
    first.begin(0)
    for batch in (rows(seconds(1), v=[1.0]), gap(2 * NS, 2 * NS, None), gap(3 * NS, 3 * NS, None)):
        first.feed(batch)
    first.advance(9 * NS)
    resumed.resume(json.loads(json.dumps(first.snapshot())))
    resumed.feed(gap(10 * NS, 3 * NS, 10 * NS))
    assert {level for _, level in levels(resumed.advance(12 * NS))} == {"stale"}


def test_rows_that_come_again_count_once() -> None:
    """Also the one right where the snapshot begins."""
    counting = mode_module(lambda _, inputs, now: {"value": float(inputs[0].at(now))})
    plan = one(mode(counting, InputPlan("a", "item", "a"), outputs=[output(VALUE)]))
    batch = rows(seconds(1, 2, 3, 4, 5), v=[1.0] * 5)
    first, resumed = Engine(plan), Engine(plan)
    first.begin(0)
    first.feed(batch)
    first.advance(5 * NS)
    resumed.resume(json.loads(json.dumps(first.snapshot())))
    resumed.feed(batch)
    resumed.feed(rows(seconds(6), v=[1.0]))
    resumed.advance(6 * NS)
    (status,) = [status for status in resumed.statuses() if status.mode]
    assert status.outputs == {"value": 6.0}


def test_a_mode_that_crashes_is_unknown_and_disturbs_nobody() -> None:
    batch = rows(seconds(1, 2, 3, 4), v=[1.0, 1.0, 3.0, 1.0])
    crashing = mode(CRASHING, variable(), id="crashing", outputs=[output()])
    findings = watch([crashing, mode(POSITIVE, variable())], [batch], 5.0)
    assert levels(findings, "crashing") == [(0.0, "unknown"), (1.0, "ok"), (3.0, "unknown")]
    last = [f for f in findings if isinstance(f, Status) and f.mode == "crashing"][-1]
    assert last.reason == "crashed: RuntimeError: above two"
    assert levels(findings) == [(0.0, "unknown"), (1.0, "ok")]


@pytest.mark.parametrize("error", [SystemExit(3), ValueError("\udcff")])
@pytest.mark.parametrize("columns", [True, False])
def test_a_mode_cannot_end_the_program(error: BaseException, columns: bool) -> None:
    def evaluate(*_: Any) -> Any:
        raise error

    findings = watch(
        [mode(mode_module(evaluate, COLUMNS=columns), variable())],
        [rows(seconds(1, 2, 3, 4, 5), v=[1.0] * 5)], 5.0,
    )  # fmt: skip
    status = [f for f in findings if isinstance(f, Status) and f.mode][-1]
    assert status.reason.startswith(f"crashed: {type(error).__name__}: ")
    assert all(encoded(finding) for finding in findings)


def test_an_explanation_is_text_that_can_be_written() -> None:
    def explain(*_: Any) -> Any:
        return "\udcff"

    module = mode_module(lambda *_: {"good": False}, explain=explain)
    findings = watch([mode(module, variable())], [rows(seconds(1), v=[1.0])], 2.0)
    assert all(encoded(finding) for finding in findings)
    assert any(isinstance(f, Status) and f.reason.endswith(": ?") for f in findings)


def test_a_value_that_is_null_is_not_known() -> None:
    batch = rows(seconds(1, 2, 3), v=np.ma.MaskedArray([1.0, 1.0, 1.0], [False, True, False]))
    found = levels(watch([mode(POSITIVE, variable())], [batch], 3.0))
    assert found == [(0.0, "unknown"), (1.0, "ok"), (2.0, "unknown"), (3.0, "ok")]


def test_rows_of_a_list_of_structures_are_fresh_while_their_messages_come() -> None:
    counted = counts(seconds(1, 2, 3, 4), [10, 20, 30, 40], seconds(1, 2, 3, 4), "a")
    batches = [rows(seconds(1.0), "a__parts", v=[1.0]), counted]
    monitored = mode(POSITIVE, variable("v", "a__parts"), stale_s=1.5)
    assert levels(watch([monitored], batches, 5.0)) == [(0.0, "unknown"), (1.0, "ok")]


def lists(at_s: float, values: Sequence[float]) -> Batch:
    """Return a message with a list of structures."""
    message = rows(seconds(at_s), "a")
    parts = rows(
        np.repeat(message.log_time_ns, len(values)), "a__parts", parent_seq=[0] * len(values),
        index=np.arange(len(values)), v=np.array(values, np.float64),
    )  # fmt: skip
    return replace(message, children={"parts": parts})


def test_a_row_that_is_no_longer_in_its_list_is_not_known() -> None:
    """Its writer has died, although messages with the other rows are still received."""
    second = mode(POSITIVE, replace(variable("v", "a__parts"), index=1))
    batches = [lists(1, [1, 2]), lists(2, [1]), lists(3, [1, 2]), lists(4, [])]
    found = [(0.0, "unknown"), (1.0, "ok"), (2.0, "unknown"), (3.0, "ok"), (4.0, "unknown")]
    assert levels(watch([second], batches, 5.0)) == found
    first, resumed = Engine(one(second)), Engine(one(second))
    first.begin(0)
    for batch in batches[:3]:
        first.feed(batch)
    first.advance(3_500_000_000)
    resumed.resume(json.loads(json.dumps(first.snapshot())))
    for batch in batches[2:]:
        resumed.feed(batch)
    assert levels(resumed.advance(5 * NS))[-1] == (4.0, "unknown")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_finite_number_is_remembered(value: float) -> None:
    """The journal keeps snapshots as strict JSON, which has no NaN and no infinity."""
    finite = mode_module(lambda _, inputs, now: {"good": bool(np.isfinite(inputs[0].at(now)))})
    plan = one(mode(finite, variable(), stale_s=None))
    first, resumed = Engine(plan), Engine(plan)
    first.begin(0)
    first.feed(rows(seconds(1), v=[value]))
    first.advance(5 * NS)
    resumed.resume(msgspec.json.decode(msgspec.json.encode(first.snapshot())))
    assert {level for _, level in levels(resumed.advance(6 * NS))} == {"error"}


def test_an_epoch_begins_with_nothing_known() -> None:
    engine = Engine(one(mode(POSITIVE, variable())))
    engine.begin(0)
    engine.feed(rows(seconds(1.0), v=[1.0]))
    engine.advance(2 * NS)
    engine.begin(NS)  # the clock went back
    found = levels(engine.advance(2 * NS))
    assert found == [(1.0, "unknown")]


_ALL = (
    mode(POSITIVE, variable(), id="fast", outputs=[output(), output(VALUE), output(WORD)]),
    mode(POSITIVE_SLOWLY, variable(), id="slow", outputs=[output(), output(VALUE), output(WORD)]),
    mode(STEADY, variable(), id="steady", outputs=[output(for_s=0.3, heal_s=0.2), output(VALUE)]),
    mode(CRASHING, variable(), id="crashing", outputs=[output()]),
    mode(ALIVE, variable(), id="alive"),
    mode(POSITIVE, variable("w", "b"), id="other", stale_s=0.7),
)


@st.composite
def records(draw: st.DrawFn) -> list[Batch]:
    """Rows of two items, counters and gaps, in batches of one row, by time."""
    steps = draw(st.lists(st.integers(1, 400), min_size=5, max_size=60))
    at_ms = np.cumsum(steps).tolist()
    batches = []
    for at in at_ms:
        ns, kind = at * 1_000_000, draw(st.sampled_from("aaaabbcg"))
        value = draw(st.sampled_from([-2.0, -0.5, 0.5, 1.5, 2.5, np.nan, np.inf]))
        if kind in "ab":
            batches.append(rows([ns], kind, **{"v" if kind == "a" else "w": [value]}))
        elif kind == "c":
            batches.append(counts([ns], [at], [max(ns - 200_000_000, 0)]))
        else:
            batches.append(gap(ns, ns, None if value < 0 else ns, "b"))
    return batches


def _as_text(findings: Sequence[Finding]) -> list[str]:
    return [str(finding) for finding in findings]


def _fed(batches: Sequence[Batch]) -> Engine:
    """Return an engine that has been given a whole record."""
    engine = Engine(one(*_ALL))
    engine.begin(0)
    for batch in batches:
        engine.feed(batch)
    return engine


def _end_ns(batches: Sequence[Batch]) -> int:
    return int(batches[-1].log_time_ns[-1]) + 2 * NS


@given(records(), st.data())
@settings(max_examples=60)
def test_findings_do_not_depend_on_how_the_record_came(batches: list[Batch], data: Any) -> None:
    """Once as a whole (a replay at full speed), once row by row in random steps (live)."""
    end_ns = _end_ns(batches)
    whole = _fed(batches)
    expected = _as_text(whole.advance(end_ns))
    live, found = Engine(one(*_ALL)), []
    live.begin(0)
    for batch in batches:
        live.feed(batch)
        complete_ns = int(batch.log_time_ns[-1]) - 1
        if data.draw(st.booleans()):
            found += live.advance(complete_ns)
    found += live.advance(end_ns)
    assert _as_text(found) == expected
    assert whole.evaluations == live.evaluations


@given(records(), st.data())
@settings(max_examples=60)
def test_a_snapshot_and_the_last_rows_are_enough_to_go_on(batches: list[Batch], data: Any) -> None:
    end_ns = _end_ns(batches)
    whole = _fed(batches)
    expected = _as_text(whole.advance(end_ns))
    first, found = Engine(one(*_ALL)), []
    first.begin(0)
    stop = data.draw(st.integers(1, len(batches)))
    for batch in batches[:stop]:
        first.feed(batch)
    until_ns = int(batches[stop - 1].log_time_ns[-1]) - 1
    found += first.advance(until_ns)
    snapshot = json.loads(json.dumps(first.snapshot()))
    second = Engine(one(*_ALL))
    second.resume(snapshot)
    since_ns = first.until_ns - round(second.history_s * NS)
    for batch in batches:
        if int(batch.log_time_ns[-1]) > since_ns:
            second.feed(batch)
    found += second.advance(end_ns)
    assert _as_text(found) == expected


@given(records())
@settings(max_examples=40)
def test_nothing_stays_green_when_the_record_goes_silent(batches: list[Batch]) -> None:
    engine = _fed(batches)
    engine.advance(int(batches[-1].log_time_ns[-1]) + 6 * NS)
    assert "ok" not in {status.level for status in engine.statuses()}


def test_instants_are_multiples_of_the_tick() -> None:
    findings = watch([mode(POSITIVE, variable())], [rows(seconds(0.123), v=[1.0])], 2.0)
    times = [f.measured_ns for f in findings if isinstance(f, Status)]
    assert all(time % TICK_NS == 0 for time in times)
    assert 150_000_000 in times


def test_the_reason_names_what_is_missing_now() -> None:
    """Of two inputs one comes back when the other is lost: the level stays the same."""
    both = mode(POSITIVE, variable(), variable("w", "b"), stale_s=1.0)
    batches = [
        rows(seconds(1, 5, 5.5, 6, 6.5), "a", v=[1.0] * 5),
        rows(seconds(2, 3, 3.9), "b", w=[1.0] * 3),
    ]
    for step_s in (7.0, 0.05):
        engine, found = Engine(one(both)), list[Finding]()
        engine.begin(0)
        for batch in batches:
            engine.feed(batch)
        for until_s in np.arange(step_s, 7.01, step_s):
            found += engine.advance(round(until_s * NS))
        reasons = [f.reason for f in found if isinstance(f, Status) and f.mode]
        assert list(dict.fromkeys(reasons)) == [
            "not measured yet",
            "nothing received yet of a.v",
            "nothing received yet of b.w",
            "",
            "nothing received of a.v for 1 s",
            "nothing received of b.w for 1 s",
        ]
