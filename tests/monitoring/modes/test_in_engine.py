"""Modes run by the engine: what it gives them besides values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.types import Batch, Column, ItemSchema, Level, Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.modes import expected, frozen, heartbeat, state_bits
from amberbox.monitoring.plan import (
    Expectation,
    InputPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)
from tests.monitoring.engine.plans import one, rows, seconds, variable

ITEM = InputPlan("a", "item", "a")


def plan(
    module: ModuleType, config: Any, entry: InputPlan, *, expects: bool = True
) -> MonitoringPlan:
    """Return a plan of one mode with its first result as output."""
    result = module.RESULTS[0]
    output = OutputPlan(result.name, "bool", result, place=0, expectation=Expectation(expects))
    mode = ModePlan("m", "m", module, config, [MappingPlan([entry], [output])], stale_s=5.0)
    return one(mode)


def levels(findings: Sequence[Any]) -> list[tuple[float, Level]]:
    """Return the levels of the mode and since when, each once."""
    found = [(f.since_ns / NS, f.level) for f in findings if isinstance(f, Status) and f.mode]
    return list(dict.fromkeys(found))


def run(engine: Engine, batches: Sequence[Batch], until_s: float) -> list[Any]:
    for batch in batches:
        engine.feed(batch)
    return list(engine.advance(round(until_s * NS)))


def begun(of: MonitoringPlan) -> Engine:
    engine = Engine(of)
    engine.begin(0)
    return engine


def test_an_item_that_is_never_heard_is_unknown_and_then_a_fault() -> None:
    engine = begun(plan(heartbeat, heartbeat.Config(window=2), ITEM))
    assert levels(run(engine, [], 5)) == [(0.0, "unknown"), (2.0, "error")]


def test_a_watcher_that_starts_again_knows_since_when_nothing_was_heard() -> None:
    of = plan(heartbeat, heartbeat.Config(window=4), ITEM)
    first = begun(of)
    run(first, [], 3)
    second = Engine(of)
    second.resume(first.snapshot())
    assert levels(run(second, [], 5))[-1] == (4.0, "error")


def test_a_new_epoch_listens_anew() -> None:
    engine = begun(plan(heartbeat, heartbeat.Config(window=2), ITEM))
    assert levels(run(engine, [], 3))[-1] == (2.0, "error")
    engine.begin(10 * NS)
    assert levels(run(engine, [], 13))[-2:] == [(10.0, "unknown"), (12.0, "error")]


def test_a_heartbeat_sees_silence() -> None:
    engine = begun(plan(heartbeat, heartbeat.Config(rate=10, window=2, max_age=1), ITEM))
    found = levels(run(engine, [rows(seconds(*np.arange(1, 4, 0.1)))], 6))
    assert [level for _, level in found] == ["unknown", "ok", "error"]
    assert 4 < found[-1][0] < 5


def with_stamps(times_s: Sequence[float], stamps_s: Sequence[float]) -> Batch:
    batch = rows(seconds(*times_s))
    schema = replace(batch.schema, stamp="header/stamp")
    return replace(batch, schema=schema, timestamp_ns=seconds(*stamps_s))


def test_stamps_of_an_item_that_stand_still() -> None:
    times = [n / 10 for n in range(1, 100)]
    engine = begun(plan(frozen, frozen.Config(window=2), ITEM))
    stopped = with_stamps(times, [min(t, 5.0) for t in times])
    found = levels(run(engine, [stopped], 9))
    assert [level for _, level in found] == ["unknown", "ok", "error"]
    assert found[-1][0] == pytest.approx(7, abs=0.2)


def test_names_of_values_come_from_the_message() -> None:
    engine = begun(plan(expected, expected.Config(one_of=("IDLE",)), variable()))
    batch = rows(seconds(1, 2, 3), v=np.array([1, 4, 1], np.uint8))
    column = Column("v", "v", "uint8", labels={1: "IDLE", 4: "ABORTED"})
    found = run(engine, [replace(batch, schema=ItemSchema("test", (column,)))], 3)
    assert [level for _, level in levels(found)] == ["unknown", "ok", "error", "ok"]
    reasons = {f.reason for f in found if isinstance(f, Status) and f.level == "error"}
    assert any("is ABORTED, should be IDLE" in reason for reason in reasons), reasons


def test_bits_of_a_word() -> None:
    engine = begun(plan(state_bits, state_bits.Config({"enabled": 0}), variable()))
    found = levels(run(engine, [rows(seconds(1, 2), v=np.array([3, 2], np.uint8))], 3))
    assert [level for _, level in found] == ["unknown", "ok", "error"]
