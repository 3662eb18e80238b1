"""What is known of a robot's faults, made ready for the engines once."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

from amberbox.core.types import FaultFacts
from amberbox.diagnosis.covering.check import Check
from amberbox.diagnosis.covering.model import Model
from amberbox.diagnosis.fmea.compile import compile_checks, compile_model
from amberbox.diagnosis.fmea.model import SEVERITIES, Fmea
from amberbox.diagnosis.fmea.propagation import Structure


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

    def facts(self, shows: Mapping[str, Collection[str]]) -> Mapping[str, FaultFacts]:
        """Return the severity of each failure mode, by itself, beside the symptoms it shows.

        It is the gravest of its own and of the system functions that are lost with it.
        """
        functions = {name: self.fmea.functions[name] for name in self.fmea.system_functions()}
        structure = Structure.of(self.fmea.needs())
        found: dict[str, FaultFacts] = {}
        for mode in self.fmea.modes.values():
            lost = structure.lost({mode.component}) if mode.takes_down else mode.effects.system
            grave = [functions[name].severity for name in lost if name in functions]
            severity = max([mode.severity, *grave], key=SEVERITIES.index)
            found[mode.id] = FaultFacts(severity, frozenset(shows.get(mode.id, ())))
        return found

    @cached_property
    def checks(self) -> Mapping[str, Check]:
        """The tests that people can do, by id."""
        return {check.id: check for check in compile_checks(self.fmea)}
