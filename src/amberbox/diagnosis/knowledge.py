"""The FMEA of a robot, and the model that the engines use, compiled from it once."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from amberbox.core.robot_status import SEVERITIES
from amberbox.core.types import FaultFacts, Symptom
from amberbox.diagnosis.covering.model import (
    Consequence,
    Function,
    Link,
    Mode,
    Model,
    Sign,
    Unknown,
)
from amberbox.diagnosis.covering.observations import Check, CheckDetection
from amberbox.diagnosis.fmea.criticality import mode_criticality
from amberbox.diagnosis.fmea.findings import finding_signs, proven_faults
from amberbox.diagnosis.fmea.model import DependencyStructure, Fmea

MOST_UNLISTED = 0.5  # a fault of unknown kind is not more probable, and shows nothing more surely


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
            mode.excludes,
        )
        for mode in fmea.modes.values()
    )
    signs = tuple(
        Sign(symptom.id, symptom.leak, bins=symptom.scale.bins if symptom.scale else 0)
        for symptom in fmea.symptoms.values()
    )
    found, found_links = finding_signs(fmea)
    unlisted, unlisted_links = _unlisted(fmea, modes)
    functions = tuple(Function(name, needs) for name, needs in fmea.needs().items())
    other = Unknown(
        fmea.other.probability,
        fmea.other.detects,
        looks_like=fmea.other.looks_like,
        together_s=fmea.other.together_s,
    )
    follows = tuple(
        Consequence(mode.id, one.mode, one.p, one.after_s)
        for mode in fmea.modes.values()
        for one in mode.leads_to
    )
    links = (*_links(fmea), *found_links, *unlisted_links)
    return Model((*modes, *unlisted), signs + found, links, functions, other, follows)


def _unlisted(fmea: Fmea, modes: Sequence[Mode]) -> tuple[list[Mode], list[Link]]:
    """Return for each component modes for its faults that are not in the FMEA, and their links.

    All of these are a share of the component's faults, one mode for each number of symptoms. They
    show the symptoms that its failure modes show, each the more probably, the more surely one of
    these shows it; any size. What detectors find in an item in which these show speaks for them,
    too. Conditions that no failure mode shows of the components that need it are together as
    probable as one such condition of its own.
    """
    other = fmea.other
    if not other.share:
        return [], []
    is_exclusive = any(mode.excludes for mode in modes)
    unshown, below = fmea.unshown(), fmea.unshown_below()
    made: list[Mode] = []
    links: list[Link] = []
    for component in dict.fromkeys(mode.component for mode in modes):
        own = [mode for mode in modes if mode.component == component]
        ids = {mode.id for mode in own}
        showing = (of.finding for of in fmea.unusual if not ids.isdisjoint(of.maps_to))
        unusual = dict.fromkeys(showing)
        prior = sum(mode.prior for mode in own) * other.share / (1.0 - other.share)
        prior = min(prior / len(other.shows), MOST_UNLISTED)
        named = [f"{component}# shows {number:g}" for number in dict.fromkeys(other.shows)]
        excludes = frozenset((*named, *(mode.id for mode in own)) if is_exclusive else ())
        most: dict[str, float] = {}
        for mode in own:
            for link in fmea.modes[mode.id].symptoms:
                most[link.symptom] = max(most.get(link.symptom, 0.0), link.detects)
        most.update(dict.fromkeys(unshown.get(component, ()), 1.0))
        for name, number in zip(named, dict.fromkeys(other.shows), strict=True):
            made.append(Mode(name, prior, excludes=excludes, is_unlisted=True))
            each = number / (sum(most.values()) or 1.0)
            links += [Link(name, finding, MOST_UNLISTED) for finding in unusual]
            links += [
                Link(name, symptom, min(MOST_UNLISTED, each * detects))
                for symptom, detects in most.items()
            ]
            of_users = below.get(component, ())
            links += [
                Link(name, symptom, min(MOST_UNLISTED, each) / len(of_users))
                for symptom in of_users
            ]
    return made, links


def _links(fmea: Fmea) -> Iterator[Link]:
    causes = [(mode.id, mode.symptoms) for mode in fmea.modes.values()]
    causes += [(function.id, function.symptoms) for function in fmea.functions.values()]
    for cause, links in causes:
        for link in links:
            scale = fmea.symptoms[link.symptom].scale
            sizes = scale.shares(link.size) if scale and link.size else ()
            yield Link(cause, link.symptom, link.detects, sizes, link.after_s)


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
            run=test.run,
            moves=test.moves,
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

    @cached_property
    def proven(self) -> Mapping[str, frozenset[str]]:
        """Return the failure modes of which one is present, by the finding that proves it."""
        return proven_faults(self.fmea)

    def level(self, symptom: Symptom) -> int | None:
        """Return the level of a present symptom's size; None if it has none."""
        known = self.fmea.symptoms.get(symptom.id)
        return known.scale.level(symptom.size) if known and known.scale else None

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
