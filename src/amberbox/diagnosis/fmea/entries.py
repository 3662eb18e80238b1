"""Failure modes, components and functions: entries of the file become what is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from amberbox.core.errors import Problem
from amberbox.core.ids import is_id
from amberbox.core.needs import NOTHING, parse_needs
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.file import (
    FmeaFile,
    FunctionFile,
    ModeFile,
    RanksFile,
    ScalesFile,
    TypeFile,
)
from amberbox.diagnosis.fmea.model import (
    Component,
    Effects,
    FailureMode,
    FmeaTest,
    Function,
    Link,
    Ranks,
)
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.reading import Part
from amberbox.diagnosis.fmea.symptoms import Symptoms
from amberbox.diagnosis.fmea.testing import results_of
from amberbox.diagnosis.fmea.vocabulary import resolve


@dataclass(frozen=True, slots=True)
class Scope:
    """What entries refer to, and the failure modes found so far."""

    file: FmeaFile
    symptoms: Symptoms
    tests: Mapping[str, FmeaTest]
    problems: list[Problem]
    modes: dict[str, FailureMode] = field(default_factory=dict)


def component_of(part: Part) -> Component:
    """Make a component."""
    modes = tuple(f"{part.component}#{name}" for name in part.modes)
    return Component(part.component, part.type, part.file.description, part.needs, modes)


def function_of(name: str, entry: FunctionFile, node: Node, scope: Scope) -> Function:
    """Make a function."""
    where = f"functions.{name}"
    needs = parse_needs(child(node, "needs"), scope.problems, f"{where}.needs") or NOTHING
    place = child(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, place, f"{where}.symptoms", name)
    if not is_id(name):
        scope.problems.append(node.problem(where, f"'{name}' is no id: a-z 0-9 _ . - only"))
    return Function(name, needs, entry.description, entry.system, entry.severity, links)


def mode_of(part: Part, name: str, scope: Scope) -> None:
    """Make a failure mode and add it to the scope."""
    entry, node = part.modes[name], part.mode_node(name)
    where = f"types.{part.type}.failure_modes.{name}"
    mode_id = f"{part.component}#{name}"
    if not is_id(name):
        scope.problems.append(node.problem(where, f"'{name}' is no id: a-z 0-9 _ . - only"))
    symptoms = child(node, "symptoms")
    links = scope.symptoms.links(entry.symptoms, symptoms, f"{where}.symptoms", mode_id)
    rate, probability = _chance(entry, part.file, scope.file.scales, node, where, scope)
    results = results_of(entry.tests, part, scope.tests, child(node, "tests"), scope.problems)
    exposure_h = scope.file.exposure_h if entry.exposure_h is None else entry.exposure_h
    mode = FailureMode(
        mode_id, part.component, name, entry.description, entry.cause,
        tuple(_classes(entry.classes, node, where, scope.problems)),
        entry.severity, rate, probability, exposure_h, entry.beta, Ranks(),
        Effects(entry.effects.local, tuple(entry.effects.next), tuple(entry.effects.system)),
        links, entry.unobservable, tuple(results), entry.remedy, entry.takes_down,
        entry.intermittent, node.line, entry.make_safe,
    )  # fmt: skip
    scope.modes[mode_id] = with_ranks(mode, entry.ranks, scope.file.scales)


def with_ranks(mode: FailureMode, given: RanksFile, scales: ScalesFile) -> FailureMode:
    """Return the mode with S, O and D: by hand, else from the tables of the file."""
    s, o, d = (given.s, given.o, given.d)
    return replace(
        mode,
        ranks=Ranks(
            scales.severity.get(mode.severity) if s is None else s,
            _rank(scales.occurrence, _hourly(mode)) if o is None else o,
            _rank(scales.detection, missed(mode.symptoms)) if d is None else d,
        ),
    )


def missed(links: Sequence[Link]) -> float:
    """Return how probable it is that none of the symptoms shows."""
    share = 1.0
    for link in links:
        share *= 1.0 - link.detects
    return share


def _hourly(mode: FailureMode) -> float:
    if mode.rate is not None:
        return mode.rate
    return (mode.probability or 0.0) / mode.exposure_h if mode.exposure_h else 0.0


def _rank(table: Mapping[str, float], value: float) -> int | None:
    """Return the lowest rank whose bound holds; the highest of the table if none does."""
    rows = sorted((int(rank), bound) for rank, bound in table.items())
    if not rows:
        return None
    return next((rank for rank, bound in rows if value <= bound), rows[-1][0])


def _chance(
    entry: ModeFile, of: TypeFile, scales: ScalesFile, node: Node, where: str, scope: Scope
) -> tuple[float | None, float | None]:
    """Return rate and probability, one of which is None."""
    if entry.probability is not None:
        return None, entry.probability
    if entry.rate is not None:
        return entry.rate, None
    if entry.ratio is not None:
        return entry.ratio * (of.rate or 0.0), None
    rate = scales.occurrence.get(str(entry.ranks.o))
    if rate is None:
        what = f"the table scales.occurrence has no rank {entry.ranks.o}"
        scope.problems.append(child(node, "ranks").problem(where, what))
    return rate, None


def _classes(
    words: Sequence[str], node: Node, where: str, problems: list[Problem]
) -> Iterator[str]:
    place = child(child(node, "class"), "classes")
    for word in words:
        try:
            yield resolve(word)
        except ValueError as error:
            problems.append(place.problem(f"{where}.class", str(error)))
