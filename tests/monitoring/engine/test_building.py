"""Modes with one input at a time, lists, probes: how inputs and outputs are bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amberbox.core.clock import NS
from amberbox.core.mode import Input, Result, where_known
from amberbox.core.probe import ProbeOrder
from amberbox.core.samples import Now
from amberbox.core.types import Batch, Output, Ragged, Status
from amberbox.monitoring.engine import Engine, evaluate_for_all
from amberbox.monitoring.plan import InputPlan, ModePlan
from amberbox.monitoring.sample_tables import figures_of
from tests.monitoring.engine.plans import GOOD, mode, mode_module, one, output, rows, seconds


def _good(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    (entry,) = inputs
    return {"good": where_known(entry.samples.known(now), entry.at(now) > 0)}


EACH = mode_module(_good, COLUMNS=True, PER_INPUT=True)
V, W = (InputPlan(f"a.{name}", "variable", "a", name) for name in "vw")


def last(plan: ModePlan, batches: Sequence[Batch], until_s: float = 3.0) -> Status:
    """Return the last status of a mode."""
    engine = Engine(one(plan))
    engine.begin(0)
    for batch in batches:
        engine.feed(batch)
    engine.advance(round(until_s * NS))
    return next(status for status in engine.statuses() if status.mode == plan.id)


def test_one_output_says_whether_all_inputs_are_well() -> None:
    plan = mode(EACH, V, W, outputs=[output()])
    good = rows(seconds(1.0, 2.0), v=[1.0, 1.0], w=[1.0, 1.0])
    bad = rows(seconds(1.0, 2.0), v=[1.0, 1.0], w=[1.0, -1.0])
    assert last(plan, [good]).level == "ok"
    assert last(plan, [bad]).level == "error"


def test_outputs_for_each_input_are_stale_each_for_itself() -> None:
    one_each = [output(place=0), replace(output(place=1), name="other")]
    other = InputPlan("b.v", "variable", "b", "v")
    plan = mode(EACH, V, other, outputs=one_each, stale_s=1.0)
    status = last(plan, [rows(seconds(1.0), v=[1.0]), rows(seconds(2.9), "b", v=[1.0])])
    assert status.outputs == {"good": None, "other": True}
    assert status.level == "stale"


@pytest.mark.parametrize(
    ("results", "joined"),
    [((1, 1), 1), ((1, 0), 0), ((2, 0), 0), ((1, 2), 2), ((1, 3), 3), ((2, 3), 2), ((None, 1), 2)],
)
def test_bad_counts_before_unknown_and_unknown_before_as_before(
    results: tuple[int | None, ...], joined: int
) -> None:
    def evaluate(config: Any, inputs: Sequence[Any], now: Now) -> Mapping[str, Any]:
        return {"good": inputs[0]}

    assert int(evaluate_for_all(evaluate, [GOOD])(None, results, 0)["good"]) == joined


def test_what_is_nominal_when_false_is_joined_the_other_way() -> None:
    pressed = Result("good", "bool", "pressed", nominal=False)

    def evaluate(config: Any, inputs: Sequence[Any], now: Now) -> Mapping[str, Any]:
        return {"good": inputs[0]}

    assert int(evaluate_for_all(evaluate, [pressed])(None, [False, True], 0)["good"]) == 1


def test_figures_of_lists() -> None:
    values = np.array([1.0, np.nan, 3.0, np.inf, 7.0])
    column = Ragged(np.array([0, 3, 3, 4, 5]), values)
    figures = figures_of(column, 4)
    assert figures["count"].tolist() == [3, 0, 1, 1]
    assert figures["finite"].tolist() == [2, 0, 0, 1]
    assert [str(v) for v in figures["mean"]] == ["2.0", "nan", "nan", "7.0"]
    assert [str(v) for v in figures["min"]] == ["1.0", "nan", "nan", "7.0"]
    assert [str(v) for v in figures["max"]] == ["3.0", "nan", "nan", "7.0"]


def test_a_list_that_is_none_is_unknown() -> None:
    assert np.ma.getmaskarray(figures_of(np.array([1.0]), 1)["mean"]).all()


def _finite(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    parts = inputs[0]
    return {"good": parts.part("finite").at(now) == parts.part("count").at(now)}


def test_a_mode_reads_the_figures_of_a_list() -> None:
    plan = mode(mode_module(_finite, COLUMNS=True), InputPlan("scan.ranges", "list", "a", "ranges"),
                outputs=[output()])  # fmt: skip
    scans = replace(
        rows(seconds(1.0, 2.0)),
        columns={"ranges": Ragged(np.array([0, 2, 4]), np.array([1.0, 2.0, 1.0, np.inf]))},
    )
    assert last(plan, [scans], 1.5).level == "ok"
    assert last(plan, [scans], 2.5).level == "error"


def test_an_element_of_a_list_is_a_variable() -> None:
    plan = mode(EACH, InputPlan("a.r[1]", "variable", "a", "r", 1), outputs=[output()])
    lists = replace(
        rows(seconds(1.0, 2.0)),
        columns={"r": Ragged(np.array([0, 2, 3]), np.array([-1.0, 2.0, 5.0]))},
    )
    assert last(plan, [lists], 1.5).level == "ok"
    assert last(plan, [lists], 2.5).reason == "a.r[1] has no value"


def test_a_probe_says_why_it_cannot_know() -> None:
    order = ProbeOrder("path_exists", "/dev/laser")
    probed = mode(EACH, InputPlan("/dev/laser", "probe", order.item, probe=order),
                  outputs=[output()])  # fmt: skip
    found = rows(
        seconds(1.0, 2.0), order.item, ok=np.ma.MaskedArray([True, False], [False, True]),
        error=np.array(["", "permission denied"], object),
    )  # fmt: skip
    assert last(probed, [found], 1.5).level == "ok"
    status = last(probed, [found], 2.5)
    assert (status.level, status.reason) == ("unknown", "/dev/laser: permission denied")


def test_what_nobody_has_probed_is_unknown_and_opens_no_alarm() -> None:
    order = ProbeOrder("path_exists", "/dev/laser")
    probed = mode(EACH, InputPlan("/dev/laser", "probe", order.item, probe=order),
                  outputs=[output()])  # fmt: skip
    found = rows(seconds(1.0), order.item, ok=[True])
    status = last(probed, [found], 8.0)
    assert (status.level, status.reason) == ("unknown", "nobody has looked at /dev/laser for 5 s")


@pytest.mark.parametrize(
    ("kind", "values", "shown"),
    [("int", [3.0], 3), ("float", [np.inf], np.inf), ("float", [np.nan], None)],
)
def test_numbers_are_shown_as_their_type_says(
    kind: Any, values: list[float], shown: Output
) -> None:
    def value(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        return {"value": inputs[0].at(now)}

    result = Result("value", kind, "the value")
    plan = mode(mode_module(value, COLUMNS=True), V, outputs=[output(result)])
    assert last(plan, [rows(seconds(1.0), v=values)]).outputs == {"value": shown}
