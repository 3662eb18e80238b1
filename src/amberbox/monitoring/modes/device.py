"""Device: the operating system shows it, which does not yet mean that it works."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amberbox.core.mode import Input, Result, where_known
from amberbox.core.samples import Now

ACCEPTS = ("probe",)
PROBE = "path_exists"
COLUMNS = True
PER_INPUT = True
RESULTS = (Result("present", "bool", "the path is there"),)
SAMPLE = """\
name: laser_device_monitor
monitor: device
description: laser devices recognised by the operating system
mappings:
  - mapping:
      inputs: [/dev/front_laser, /dev/rear_laser]
      outputs:
        - output: {name: front_laser_present, type: bool, expected: true}
        - output: {name: rear_laser_present, type: bool, expected: true}
"""


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """A device needs no arguments."""


Config = DeviceOptions


def evaluate(config: DeviceOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Return whether the path existed when it was last checked."""
    (path,) = inputs
    return {"present": where_known(path.samples.known(now), path.at(now))}


def explain(config: DeviceOptions, results: Mapping[str, Any]) -> str:
    """Describe that the path is missing."""
    missing = results["present"] is False
    return "the operating system does not show the device" if missing else ""
