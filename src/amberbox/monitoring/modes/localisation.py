"""Localisation: the robot knows where it is, by the variances of its pose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, numbers_at, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples

ACCEPTS = ("variable", "item")
COLUMNS = True
PARTS = True
RESULTS = (
    Result("localised", "bool", "the mean of the variances is below the threshold"),
    Result("variance_x", "float", "variance along x", "m^2", relation="<="),
    Result("variance_y", "float", "variance along y", "m^2", relation="<="),
    Result("variance_theta", "float", "variance of the heading", "rad^2", relation="<="),
)
SAMPLE = """\
name: localisation_functional_monitor
monitor: localisation
description: the pose estimate is certain enough to drive
stale_after: never
mappings:
  - mapping:
      inputs: [/amcl_pose]
      outputs:
        - output: {name: variance_x, type: float}
        - output: {name: variance_y, type: float}
        - output: {name: variance_theta, type: float}
        - output: {name: localised, type: bool}
arguments:
  avg_variance_threshold: 0.01
"""
_DIAGONAL = (0, 7, 35)  # x, y and heading in a covariance of 6 x 6


@dataclass(frozen=True, slots=True)
class LocalisationOptions:
    """How certain is certain enough."""

    avg_variance_threshold: float = option(0.01, "what the mean of the variances must be below")
    covariance: str = option(
        "pose_covariance", "the columns of the covariance, where an input is an item"
    )

    def check(self) -> Iterator[Finding]:
        """Refuse a threshold that nothing is below."""
        if not 0 < self.avg_variance_threshold < inf:
            yield "avg_variance_threshold", "must lie above 0"


Config = LocalisationOptions


def evaluate(config: LocalisationOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Compare the mean of the variances; in ROS all zero means that they are not known."""
    chosen = _chosen(config, inputs)
    x, y, theta = variances = [numbers_at(one, now) for one in chosen]
    mean = (x + y + theta) / 3
    sane = np.min(variances, axis=0) >= 0
    known = np.logical_and.reduce([one.samples.known(now) for one in chosen])
    known &= np.max(np.abs(variances), axis=0) != 0
    localised = where_known(known, sane & (mean < config.avg_variance_threshold))
    return {"localised": localised, "variance_x": x, "variance_y": y, "variance_theta": theta}


def _chosen(config: LocalisationOptions, inputs: Sequence[Input]) -> Sequence[Input]:
    """Return x, y and heading of three inputs, of a whole covariance, or of an item."""
    if len(inputs) == 1:
        parts = inputs[0].parts
        names = [f"{config.covariance}_{place}" for place in _DIAGONAL]
        return [Input(name, parts.get(name, Samples())) for name in names]
    return [inputs[place] for place in _DIAGONAL] if len(inputs) == 36 else inputs


def explain(config: LocalisationOptions, results: Mapping[str, Any]) -> str:
    """Describe how uncertain it is."""
    variances = [results[f"variance_{axis}"] for axis in ("x", "y", "theta")]
    if results["localised"] is not False:
        return ""
    if None in variances:
        return "a variance is no number"
    mean = sum(variances) / 3
    return f"the mean variance is {mean:.3g}, less than {config.avg_variance_threshold:g} expected"
