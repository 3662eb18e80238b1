"""Plans and rows for tests of the engine: small modes, items with made-up samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.mode import Input, Result, with_hysteresis
from amberbox.core.samples import Now
from amberbox.core.types import Batch, Column, IntArray, ItemSchema
from amberbox.monitoring.plan import (
    ComponentPlan,
    Expectation,
    InputPlan,
    MappingPlan,
    ModePlan,
    MonitoringPlan,
    OutputPlan,
)

GOOD = Result("good", "bool", "it is well")
VALUE = Result("value", "float", "the value")
WORD = Result("word", "string", "a word for it")


def _positive(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Good above 0, bad below -1, as before in between."""
    value = inputs[0].at(now)
    word = np.where(value > 0, "up", "down").astype(object)[()]
    return {"good": with_hysteresis(value > 0, value < -1), "value": value, "word": word}


def _steady(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Good while the mean of the last second stays below 1: depends on time alone, too."""
    mean = inputs[0].over(now, 1.0).mean()
    return {"good": ~(mean >= 1), "value": mean}


def _crashing(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    if np.any(inputs[0].at(now) > 2):
        raise RuntimeError("above two")
    return {"good": np.ones(np.shape(now), bool)[()]}


def _alive(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    return {"good": inputs[0].age_s(now) < 1.0, "value": inputs[0].rate_hz(now, 2.0)}


def mode_module(evaluate: Any, **marks: Any) -> Any:
    """Make a module of a function."""
    return SimpleNamespace(
        evaluate=evaluate, RESULTS=(GOOD, VALUE, WORD), ACCEPTS=("variable",), **marks
    )


POSITIVE = mode_module(_positive, COLUMNS=True)
POSITIVE_SLOWLY = mode_module(_positive)
STEADY = mode_module(_steady, COLUMNS=True, TIMED=True, history_s=lambda config: 1.0)
CRASHING = mode_module(_crashing, COLUMNS=True)
ALIVE = mode_module(
    _alive, COLUMNS=True, TIMED=True, SEES_SILENCE=True, history_s=lambda config: 2.0
)


def variable(name: str = "v", item: str = "a") -> InputPlan:
    """Return an input of a variable."""
    return InputPlan(f"{item}.{name}", "variable", item, name)


def output(result: Result = GOOD, **options: Any) -> OutputPlan:
    """Return an output; a bool one expects its nominal value."""
    expectation = Expectation(True) if result.type == "bool" else Expectation()
    given = {"expectation": expectation, **options}
    return OutputPlan(result.name, result.type, result, **given)


def mode(
    module: Any,
    *inputs: InputPlan,
    outputs: Sequence[OutputPlan] = (output(), output(VALUE)),
    **options: Any,
) -> ModePlan:
    """Return a mode of one mapping."""
    name = options.pop("id", "m")
    return ModePlan(name, name, module, None, [MappingPlan(inputs, outputs)], **options)


def one(*modes: ModePlan) -> MonitoringPlan:
    """Return a plan of one component."""
    return MonitoringPlan("robot", "hash", [ComponentPlan("part", "part", modes)])


def rows(times_ns: Any, item: str = "a", /, **columns: Any) -> Batch:
    """Return rows of an item at log times."""
    times: IntArray = np.asarray(times_ns, np.int64)
    given = {name: np.asanyarray(values) for name, values in columns.items()}
    schema = ItemSchema("test", tuple(Column(name, name, "float64") for name in given))
    numbers = np.arange(len(times))
    return Batch(item, schema, "main", 1, numbers, times, times, times, given)


def counts(times_ns: Any, received: Any, last_ns: Any, item: str = "a") -> Batch:
    """Return the recorder's counters of one item."""
    times: IntArray = np.asarray(times_ns, np.int64)
    columns = {
        "item": np.array([item] * len(times), object),
        "received": np.asarray(received, np.int64),
        "last_received_ns": np.asarray(last_ns, np.int64),
    }
    child = rows(times, "amberbox_counters__items", **columns)
    whole = rows(times, "amberbox_counters")
    return Batch(
        whole.item, whole.schema, "main", 1, whole.seq, times, times, times, {},
        children={"items": child},
    )  # fmt: skip


def gap(at_ns: int, from_ns: int, to_ns: int | None, item: str = "a") -> Batch:
    """Return a gap as the recorder writes it down when it opens, or closes."""
    ends = np.ma.MaskedArray([to_ns or 0], [to_ns is None])
    return rows(
        [at_ns], "amberbox_gap", item=np.array([item], object), peer=np.array(["p"], object),
        from_ns=[from_ns], to_ns=ends, reason=np.array(["lost"], object),
    )  # fmt: skip


def seconds(*values: float) -> IntArray:
    """Return times."""
    return np.round(np.array(values) * NS).astype(np.int64)
