"""Read the entries of the file one by one, so that a wrong one does not hide what else is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.needs import NOTHING, Needs, parse_needs
from amberbox.core.nodes import Node
from amberbox.diagnosis.fmea.file import (
    MOST_PER_HOUR,
    FindingFile,
    FmeaFile,
    FunctionFile,
    MemberFile,
    ModeFile,
    SymptomFile,
    TestFile,
    TypeFile,
)
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.writing_out import Instance, instances

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Part:
    """A component as the file has it: its type written out."""

    component: str
    type: str
    file: TypeFile
    node: Node
    needs: Needs
    modes: Mapping[str, ModeFile]
    tests: Mapping[str, TestFile]
    symptoms: Mapping[str, SymptomFile]

    def mode_node(self, name: str) -> Node:
        """Return where a failure mode stands."""
        return child(_modes_node(self.node), name)


@dataclass(frozen=True, slots=True)
class Sheet:
    """Everything that could be read, and the names of all that is there.

    ``folder`` has the components that only the robot folder has, with their needs.
    """

    root: Node
    file: FmeaFile
    parts: Sequence[Part]
    functions: Mapping[str, FunctionFile]
    tests: Mapping[str, TestFile]
    symptoms: Mapping[str, SymptomFile]
    robots: Mapping[str, MemberFile]
    names: frozenset[str]
    folder: Mapping[str, Needs]
    findings: Sequence[tuple[Node, FindingFile]] = ()


def read(root: Node, known: Known | None, problems: list[Problem]) -> Sheet:
    """Read the file; what is wrong is left out and told."""
    file = build(FmeaFile, root, problems) or FmeaFile()
    found = instances(root, problems)
    here = {entry.component for entry in found} | set(child_keys(root, "functions"))
    others = {name: of for name, of in (known.needs if known else {}).items() if name not in here}
    names = here | others.keys()
    return Sheet(
        root,
        file,
        [_part(entry, names, known, problems) for entry in found],
        dict(_entries(FunctionFile, root, "functions", problems)),
        dict(_entries(TestFile, root, "tests", problems)),
        dict(_entries(SymptomFile, root, "symptoms", problems)),
        dict(_entries(MemberFile, root, "robots", problems)),
        frozenset(names),
        {name: of.restricted(names.__contains__) for name, of in others.items()},
        list(_findings(root, problems)),
    )


def child_keys(node: Node, key: str) -> tuple[str, ...]:
    """Return the names of the entries below a key."""
    entry = (node.mapping or {}).get(key)
    return tuple((entry.mapping if entry else None) or ())


def _part(entry: Instance, names: set[str], known: Known | None, problems: list[Problem]) -> Part:
    """Read a type for one of its components."""
    where = f"types.{entry.type}"
    file = build(TypeFile, entry.node, problems, where) or TypeFile()
    node = entry.node
    key = "failure_modes" if _modes_node(node) is child(node, "failure_modes") else "modes"
    modes = dict(_entries(ModeFile, node, key, problems, where))
    problems += rate_notes(file.rate, node, where)
    for name, mode in modes.items():
        problems += rate_notes(mode.rate, child(node, key, name), f"{where}.{key}.{name}")
    problems += _ratio_problems(file, modes, node, where)
    return Part(
        entry.component,
        entry.type,
        file,
        node,
        _needs(node, entry.component, names, known, problems),
        modes,
        dict(_entries(TestFile, node, "tests", problems, where)),
        dict(_entries(SymptomFile, node, "symptoms", problems, where)),
    )


def _modes_node(node: Node) -> Node:
    entries = child(node, "failure_modes")
    return child(node, "modes") if entries is node else entries


def _needs(
    node: Node, component: str, names: set[str], known: Known | None, problems: list[Problem]
) -> Needs:
    """Return what the type says that it needs, else what the component's own file says.

    Of the latter, what is not in this file is taken to be up.
    """
    entry = (node.mapping or {}).get("needs")
    if entry is not None:
        where = f"{component}.needs"
        return parse_needs(entry, problems, where, may_be_empty=True) or NOTHING
    inherited = known.needs.get(component, NOTHING) if known else NOTHING
    return inherited.restricted(names.__contains__)


def _entries(
    cls: type[T], node: Node, key: str, problems: list[Problem], where: str = ""
) -> Iterator[tuple[str, T]]:
    """Yield the entries below a key that can be read."""
    place = (node.mapping or {}).get(key)
    where = f"{where}.{key}" if where else key
    if place is None or place.value is None:
        return
    if place.mapping is None:
        what = f"expected a mapping (key: value), got {place.kind}"
        problems.append(place.problem(where, what))
    for name, entry in (place.mapping or {}).items():
        built = build(cls, entry, problems, f"{where}.{name}")
        if built is not None:
            yield name, built


def _findings(root: Node, problems: list[Problem]) -> Iterator[tuple[Node, FindingFile]]:
    """Yield what other engines find, each with its place."""
    place = (root.mapping or {}).get("findings")
    if place is None or place.value is None:
        return
    if place.items is None:
        problems.append(
            place.problem("findings", f"expected a list (- rule: ...), got {place.kind}")
        )
    for number, entry in enumerate(place.items or ()):
        built = build(FindingFile, entry, problems, f"findings[{number}]")
        if built is not None:
            yield entry, built


def rate_notes(rate: float | None, node: Node, where: str) -> Iterator[Problem]:
    """Yield a note on a rate per hour that no part of a robot has."""
    if rate is not None and rate > MOST_PER_HOUR:
        hours = 1 / rate
        every = f"{hours * 60:.3g} min" if hours * 60 >= 1 else f"{hours * 3600:.3g} s"
        what = f"{rate:g} per hour is one failure every {every}; did you mean {hours:.3g}?"
        hint = "a rate is failures per hour: 1 / (hours between two failures)"
        yield child(node, "rate").problem(f"{where}.rate", what, hint, is_error=False)


def _ratio_problems(
    file: TypeFile, modes: Mapping[str, ModeFile], node: Node, where: str
) -> Iterator[Problem]:
    """Yield what is wrong with shares of a component's failures."""
    ratios = {name: mode.ratio for name, mode in modes.items() if mode.ratio is not None}
    place = _modes_node(node)
    if sum(ratios.values()) > 1 + 1e-9:
        what = f"their ratios sum up to {sum(ratios.values()):g}, more than 1"
        yield place.problem(f"{where}.failure_modes", what)
    for name in ratios if file.rate is None else ():
        what = "it has a ratio, but the type has no rate"
        yield child(place, name).problem(f"{where}.failure_modes.{name}", what)
