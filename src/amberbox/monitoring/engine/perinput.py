"""Modes that look at one input alone, called for several: well are they if all are well."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from amberbox.core.mode import FALSE, HOLD, TRUE, UNKNOWN, Input, Result
from amberbox.core.samples import Now


def for_all(
    evaluate: Callable[..., Mapping[str, Any]], results: Sequence[Result]
) -> Callable[..., Mapping[str, Any]]:
    """Return a function of several inputs: its bools are nominal where those of all inputs are."""
    nominal = {r.name: r.nominal for r in results if r.type == "bool"}

    def evaluate_all(config: Any, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
        each = [evaluate(config, [entry], now) for entry in inputs]
        return {name: _joined([r.get(name) for r in each], nominal[name]) for name in nominal}

    return evaluate_all


def _joined(results: Sequence[Any], nominal: bool) -> Any:
    """Join bools: bad where one is, else unknown where one is, else as before where one is."""
    good, bad = (TRUE, FALSE) if nominal else (FALSE, TRUE)
    if any(result is None for result in results):
        results = [UNKNOWN if result is None else result for result in results]
    codes = [np.asarray(result).astype(np.int8) for result in results]
    held = np.where(_any(codes, HOLD), HOLD, good)
    unknown = np.where(_any(codes, UNKNOWN), UNKNOWN, held)
    return np.where(_any(codes, bad), bad, unknown)


def _any(codes: Sequence[Any], value: int) -> Any:
    return np.logical_or.reduce([code == value for code in codes])
