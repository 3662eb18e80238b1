"""The FMEA of a robot, and the model that the engines use, compiled from it once."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from amberbox.core.robot_status import SEVERITIES
from amberbox.core.types import FaultFacts
from amberbox.diagnosis.covering.model import Function, Link, Mode, Model, Sign, Unknown
from amberbox.diagnosis.covering.observations import Check, CheckDetection
from amberbox.diagnosis.fmea.criticality import mode_criticality
from amberbox.diagnosis.fmea.findings import finding_signs
from amberbox.diagnosis.fmea.model import DependencyStructure, Fmea


def compile_model(fmea: Fmea, exposure_h: float | None = None) -> Model:
    """Return the model of a robot that was known to be well ``exposure_h`` hours ago.

    Without an exposure each failure mode has its own. A mode's criticality is its C_m.
    """
    modes = tuple(
        Mode(
            mode.id,
            mode.chance(exposure_h),
            mode.takes_down,
            mode_criticality(mode, exposure_h),
        )
        for mode in fmea.modes.values()
    )
    signs = tuple(Sign(symptom.id, symptom.leak) for symptom in fmea.symptoms.values())
    found, found_links = finding_signs(fmea)
    functions = tuple(Function(name, needs) for name, needs in fmea.needs().items())
    other = Unknown(
        fmea.other.probability,
        fmea.other.detects,
        looks_like=fmea.other.looks_like,
        together_s=fmea.other.together_s,
    )
    return Model(modes, signs + found, (*_links(fmea), *found_links), functions, other)


def _links(fmea: Fmea) -> Iterator[Link]:
    causes = [(mode.id, mode.symptoms) for mode in fmea.modes.values()]
    causes += [(function.id, function.symptoms) for function in fmea.functions.values()]
    for cause, links in causes:
        for link in links:
            yield Link(cause, link.symptom, link.detects)


def compile_checks(fmea: Fmea) -> tuple[Check, ...]:
    """Return the tests with the outcomes that each failure mode causes."""
    detections: dict[str, list[CheckDetection]] = {name: [] for name in fmea.tests}
    for mode in fmea.modes.values():
        for given in mode.tests:
            detections[given.test].append(CheckDetection(mode.id, given.outcome, given.detects))
    return tuple(
        Check(
            test.id,
            test.kind,
            test.text,
            test.role,
            test.cost_s,
            test.risk,
            test.outcomes,
            test.sure,
            tuple(detections[test.id]),
        )
        for test in fmea.tests.values()
    )


@dataclass(frozen=True)
class Knowledge:
    """The FMEA of a robot, and the model and tests compiled from it.

    ``exposure_h`` is the time since all components were known to work, in hours; None for the
    file's value. ``config_hash`` is that of the folder it comes from.
    """

    robot: str
    fmea: Fmea
    config_hash: str = ""
    exposure_h: float | None = None

    @cached_property
    def model(self) -> Model:
        """Return the model of the covering engine."""
        return compile_model(self.fmea, self.exposure_h)

    def facts(self, shows: Mapping[str, Collection[str]]) -> Mapping[str, FaultFacts]:
        """Return the severity of each failure mode alone, and the symptoms it shows.

        It is the worst of its own and of the system functions that are lost with it.
        """
        functions = {name: self.fmea.functions[name] for name in self.fmea.system_functions()}
        structure = DependencyStructure.of(self.fmea.needs())
        found: dict[str, FaultFacts] = {}
        for mode in self.fmea.modes.values():
            lost = structure.lost({mode.component}) if mode.takes_down else mode.effects.system
            grave = [functions[name].severity for name in lost if name in functions]
            severity = max([mode.severity, *grave], key=SEVERITIES.index)
            found[mode.id] = FaultFacts(severity, frozenset(shows.get(mode.id, ())))
        return found

    @cached_property
    def checks(self) -> Mapping[str, Check]:
        """Return the tests that people can do, by id."""
        return {check.id: check for check in compile_checks(self.fmea)}
