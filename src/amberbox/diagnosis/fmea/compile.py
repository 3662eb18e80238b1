"""From the analysis to the numbers and tests that the covering engine reasons with."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.diagnosis.covering.check import Check, Sight
from amberbox.diagnosis.covering.model import Function, Link, Mode, Model, Sign, Unknown
from amberbox.diagnosis.fmea.criticality import mode_criticality
from amberbox.diagnosis.fmea.findings import finding_signs
from amberbox.diagnosis.fmea.model import Fmea


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
    """Return the tests with what each failure mode makes them give."""
    sights: dict[str, list[Sight]] = {name: [] for name in fmea.tests}
    for mode in fmea.modes.values():
        for given in mode.tests:
            sights[given.test].append(Sight(mode.id, given.outcome, given.detects))
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
            tuple(sights[test.id]),
        )
        for test in fmea.tests.values()
    )
