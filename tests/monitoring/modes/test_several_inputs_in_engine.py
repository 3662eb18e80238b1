"""Modes with several inputs, or with whole tables, run by the engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.expression import parse
from amberbox.core.mode import Result
from amberbox.core.probe import ProbeOrder
from amberbox.core.types import Batch, Output, Status
from amberbox.monitoring.engine import Engine
from amberbox.monitoring.modes import (
    battery,
    diagnostics,
    expression,
    host,
    localisation,
    log_pattern,
    network,
    redundancy,
    service,
    working_counter,
)
from amberbox.monitoring.plan import Expectation, InputPlan, MappingPlan, ModePlan, OutputPlan
from tests.monitoring.engine.plans import one, rows, seconds, variable

WHEELS = [variable(f"v{k}") for k in range(4)]
TIMES = seconds(*np.arange(1, 11))


def outputs(results: Sequence[Result]) -> list[OutputPlan]:
    return [
        OutputPlan(r.name, r.type, r, expectation=Expectation(True if r.type == "bool" else None))
        for r in results
    ]


def run(
    module: ModuleType,
    config: Any,
    inputs: Sequence[InputPlan],
    batches: Sequence[Batch],
    until_s: float,
    *,
    bools: int = 1,
    reads: Sequence[InputPlan] = (),
) -> Status:
    """Return the last status of the mode, which replay and live agree about."""
    results_of = getattr(module, "results_of", None)
    results = results_of(config, len(inputs), bools) if results_of else module.RESULTS
    mapping = MappingPlan(inputs, outputs(results), reads)
    last = [
        _run(ModePlan("m", "m", module, config, [mapping]), batches, until_s, step_s)
        for step_s in (until_s, 0.1)
    ]
    assert last[0] == last[1]
    return last[0]


def _run(mode: ModePlan, batches: Sequence[Batch], until_s: float, step_s: float) -> Status:
    engine = Engine(one(mode))
    engine.begin(0)
    for batch in batches:
        engine.feed(batch)
    for until in np.arange(step_s, until_s + step_s / 2, step_s):
        engine.advance(round(until * NS))
    return next(status for status in engine.statuses() if status.mode)


def values(status: Status, *names: str) -> list[Output]:
    return [status.outputs[name] for name in names]


def test_the_odd_barometer_is_named() -> None:
    same = np.full(10, 1015.0)
    odd = np.where(np.arange(10) < 5, 1015.0, 1080.0)
    batch = rows(TIMES, v0=same, v1=same, v2=odd, v3=same)
    config = redundancy.Config(threshold=10.0)
    status = run(redundancy, config, WHEELS, [batch], 10, bools=4)
    assert values(status, "member_1", "member_2", "member_3", "member_4") == [
        True, True, False, True
    ]  # fmt: skip
    assert "member 3 is off by 65" in status.reason


def test_one_output_about_all_members_says_who_it_is() -> None:
    batch = rows(TIMES, v0=np.full(10, 1.0), v1=np.full(10, 1.0), v2=np.full(10, 9.0))
    status = run(redundancy, redundancy.Config(threshold=1.0), WHEELS[:3], [batch], 10)
    assert values(status, "agree", "residual") == [False, 8.0]
    assert "member 3 is off by 8" in status.reason


def test_a_battery_at_4_volts_is_an_error() -> None:
    batch = rows(TIMES, v0=np.full(10, 4.0))
    status = run(battery, battery.Config(empty=5, full=30), WHEELS[:1], [batch], 10)
    assert (status.level, status.outputs["ok"]) == ("error", False)


def test_an_expression_reads_what_it_names() -> None:
    config = expression.Config(condition=parse("a.v0 < 5 or a.v1 > 1"))
    batch = rows(TIMES, v0=np.arange(10.0), v1=np.zeros(10))
    for until_s, level in ((5, "ok"), (10, "error")):
        status = run(expression, config, [], [batch], until_s, reads=WHEELS[:2])
        assert status.level == level


def entries(times_ns: Any, names: Sequence[str], levels: Sequence[int]) -> Batch:
    columns: Mapping[str, Any] = {
        "name": np.array(names, object),
        "level": np.array(levels, np.int8),
        "message": np.array(
            [f"{name} says {level}" for name, level in zip(names, levels, strict=True)], object
        ),
    }
    return rows(times_ns, "d__status", **columns)


def test_diagnostics_read_the_rows_of_the_table() -> None:
    times = np.repeat(TIMES, 2)
    levels = [0, 0] * 9 + [0, 2]
    batch = entries(times, ["imu", "laser"] * 10, levels)
    config = diagnostics.Config(names=("imu", "laser"))
    entry = InputPlan("d__status", "item", "d__status")
    assert run(diagnostics, config, [entry], [batch], 9).level == "ok"
    status = run(diagnostics, config, [entry], [batch], 10)
    assert values(status, "ok", "level", "message") == [False, 2, "laser: laser says 2"]
    assert "laser says 2" in status.reason


def probe_rows(kind: str, subject: str, **columns: Any) -> tuple[InputPlan, Batch]:
    order = ProbeOrder(kind, subject)
    batch = rows(TIMES, order.item, ok=np.ones(10, bool), **columns)
    return InputPlan(f"{kind} {subject}", "probe", order.item, probe=order), batch


def cases() -> list[Any]:
    """Return each mode with inputs that are well until second 10."""
    v = [rows(TIMES, v0=np.full(10, 25.0), v1=np.full(10, 25.0), v2=np.full(10, 25.0))]
    text = [rows(TIMES, v0=np.array(["fine"] * 10, object))]
    imu = [entries(TIMES, ["imu"] * 10, [0] * 10)]
    cpu, cpu_rows = probe_rows("cpu", "all", percent=np.full(10, 5.0))
    wifi, wifi_rows = probe_rows("wifi", "wlan0", quality_percent=np.full(10, 70.0))
    unit, unit_rows = probe_rows("unit_active", "roscore")
    status = InputPlan("d__status", "item", "d__status")
    below = expression.Config(condition=parse("input_1 < 30"))
    known = [
        (redundancy, redundancy.Config(threshold=1.0), WHEELS[:3], v),
        (battery, battery.Config(), WHEELS[:1], v),
        (working_counter, working_counter.Config(expected=25), WHEELS[:1], v),
        (localisation, localisation.Config(avg_variance_threshold=30.0), WHEELS[:3], v),
        (log_pattern, log_pattern.Config("bad"), WHEELS[:1], text),
        (expression, below, WHEELS[:1], v),
        (diagnostics, diagnostics.Config(names=("imu",)), [status], imu),
        (host, host.Config(), [cpu], [cpu_rows]),
        (network, network.Config(), [wifi], [wifi_rows]),
        (service, service.Config(), [unit], [unit_rows]),
    ]
    return [pytest.param(*case, id=case[0].__name__.rpartition(".")[2]) for case in known]


@pytest.mark.parametrize(("module", "config", "inputs", "batches"), cases())
def test_nothing_stays_green_when_its_source_dies(
    module: ModuleType, config: Any, inputs: Sequence[InputPlan], batches: Sequence[Batch]
) -> None:
    assert run(module, config, inputs, batches, 0.5).level == "unknown"
    assert run(module, config, inputs, batches, 10).level == "ok"
    own_probes = any(entry.kind == "probe" for entry in inputs)
    assert run(module, config, inputs, batches, 16).level == ("unknown" if own_probes else "stale")
