"""Residual: measurements fit the equations of a model of the robot folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.equations.generator import Differentiated, ResidualGenerator, generator_of
from amberbox.core.equations.model_file import load_model
from amberbox.core.equations.residual import IDLE, UNKNOWN, VIOLATED, WITHIN, concluded
from amberbox.core.errors import UsageError
from amberbox.core.expression import number_text
from amberbox.core.mode import FALSE, HOLD, TRUE, Given, Input, Result
from amberbox.core.mode import UNKNOWN as NOT_KNOWN
from amberbox.core.options import option
from amberbox.core.samples import Now, Samples, is_one

ACCEPTS = ("variable",)
COLUMNS = True
TIMED = True
RESULTS = (
    Result("consistent", "bool", "the residual has not been above its threshold"),
    Result("size", "float", "the size of the residual; unknown where nothing is concluded"),
)
SAMPLE = """\
name: odometry_monitor
monitor: residual
description: odometry is as fast as the wheels
mappings:
  - mapping:
      inputs: []
      outputs:
        - output: {name: as_the_wheels, type: bool, severity: urgent}
        - output: {name: size, type: float}
arguments:
  model: models/base.yaml
  residual: odometry_speed
"""
_VERDICTS = np.array([0, 0, 0, 0])
_VERDICTS[[UNKNOWN, IDLE, WITHIN, VIOLATED]] = NOT_KNOWN, HOLD, TRUE, FALSE


@dataclass(frozen=True)
class ResidualMonitorOptions:
    """Residuals that a model of equations lists."""

    model: str = option(doc="the file of the model, seen from the robot folder")
    residual: str | list[str] = option(
        doc="the residual, as the model calls it; of several each has a bool output, in their order"
    )

    @property
    def names(self) -> Sequence[str]:
        """Return the names of the residuals."""
        return [self.residual] if isinstance(self.residual, str) else self.residual

    def check(self) -> Iterator[Finding]:
        """Yield an error where no residual is named, or one twice."""
        if not self.names:
            yield "residual", "name a residual of the model"
        if len(set(self.names)) < len(self.names):
            yield "residual", "names one twice"


@dataclass(frozen=True)
class LoadedResiduals(ResidualMonitorOptions):
    """The same with the generators of the residuals."""

    generators: tuple[ResidualGenerator, ...] = ()

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the recorded addresses that they read, each once."""
        return tuple(dict.fromkeys(a for one in self.generators for a in one.addresses))


Config = ResidualMonitorOptions


def in_folder(config: ResidualMonitorOptions, folder: Path) -> LoadedResiduals:
    """Return the options with the residuals of the folder's model.

    Raises ConfigurationError for mistakes in the model, UsageError for a residual that cannot be
    computed or has no threshold yet.
    """
    model = load_model(folder / config.model)
    found = [generator_of(model, name) for name in config.names]
    for generator in found:
        if generator.options.threshold is None:
            raise UsageError(
                f"the residual '{generator.name}' of {config.model} has no threshold",
                "amberbox structure MODEL.yaml --residuals WHERE --learn finds one",
            )
    return LoadedResiduals(config.model, config.residual, tuple(found))


def reads(config: ResidualMonitorOptions) -> tuple[str, ...]:
    """Return the recorded variables of its equations."""
    return config.addresses if isinstance(config, LoadedResiduals) else ()


def history_s(config: ResidualMonitorOptions) -> float:
    """Return how far back it looks."""
    found = config.generators if isinstance(config, LoadedResiduals) else ()
    return max((one.history_ns for one in found), default=0) / NS


def shortest_s(config: ResidualMonitorOptions) -> float:
    """Return its shortest window."""
    found = config.generators if isinstance(config, LoadedResiduals) else ()
    windows = [one.options.over_s for one in found]
    for generator in found:
        steps = (*generator.steps, generator.compared)
        windows += [step.window_ns / NS for step in steps if isinstance(step, Differentiated)]
    return min(windows, default=0.0)


def results_of(config: ResidualMonitorOptions, inputs: int, bools: int) -> tuple[Result, ...]:
    """Return verdict and size of the residual, or of each of several."""
    if isinstance(config.residual, str):
        return RESULTS
    return tuple(
        replace(result, name=f"{result.name}_{number}")
        for result in RESULTS
        for number in range(1, len(config.residual) + 1)
    )


def evaluate(
    config: ResidualMonitorOptions, inputs: Sequence[Input], now: Now
) -> Mapping[str, Any]:
    """Return whether each residual is small enough, and its size, at each instant."""
    found: dict[str, Any] = {}
    shared: dict[Any, Any] = {}
    instants, samples = np.atleast_1d(np.asarray(now)), _samples(config, inputs)
    for number, generator in enumerate(_generators(config), 1):
        mark = "" if isinstance(config.residual, str) else f"_{number}"
        made = concluded(generator, samples, instants, shared)
        verdicts = _VERDICTS[made.states]
        found[f"consistent{mark}"] = int(verdicts[0]) if is_one(now) else verdicts
        found[f"size{mark}"] = made.sizes[0] if is_one(now) else made.sizes
    return found


def _generators(config: ResidualMonitorOptions) -> Sequence[ResidualGenerator]:
    return config.generators if isinstance(config, LoadedResiduals) else ()


def _samples(config: ResidualMonitorOptions, inputs: Sequence[Input]) -> Mapping[str, Samples]:
    addresses = reads(config)
    own = inputs[len(inputs) - len(addresses) :]
    return {name: one.samples for name, one in zip(addresses, own, strict=True)}


def reason(config: ResidualMonitorOptions, given: Given) -> str:
    """Write sizes above thresholds, and the components whose equations do not fit."""
    told = []
    for generator in _generators(config):
        samples = _samples(config, given.inputs)
        made = concluded(generator, samples, np.array([given.now_ns], np.int64))
        if made.states[0] == VIOLATED:
            who = f" ({', '.join(generator.components)})" if generator.components else ""
            size, limit = number_text(float(made.sizes[0])), generator.options.threshold
            told.append(f"{generator.name} is off by {size}, at most {limit:g}{who}")
    return "; ".join(told)


def measure(config: ResidualMonitorOptions, result: str, inputs: Sequence[str]) -> str:
    """Return the name of the result that is the size."""
    return result.replace("consistent", "size")
