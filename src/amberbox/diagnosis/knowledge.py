"""What is known of a robot's faults, made ready for the engines once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.fmea.compile import compile_checks, compile_model
from amberbox.diagnosis.fmea.model import Fmea


@dataclass(frozen=True)
class Knowledge:
    """The FMEA of a robot and what is compiled from it.

    ``exposure_h`` is how long ago everything was known to be well, None for what the file says.
    ``config_hash`` is that of the folder it comes from.
    """

    robot: str
    fmea: Fmea
    config_hash: str = ""
    exposure_h: float | None = None

    @cached_property
    def model(self) -> Model:
        """The numbers that the covering engine reasons with."""
        return compile_model(self.fmea, self.exposure_h)

    @cached_property
    def checks(self) -> Mapping[str, Check]:
        """The tests that people can do, by id."""
        return {check.id: check for check in compile_checks(self.fmea)}
