"""From ``fmea.yaml`` to the analysis as it is used; everything wrong is said at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from amberbox.core.config import parse_yaml
from amberbox.core.errors import Problem
from amberbox.core.needs import Needs, cycles
from amberbox.core.nodes import Node, load_yaml
from amberbox.diagnosis.fmea.checking import check
from amberbox.diagnosis.fmea.entries import Scope, component_of, function_of, mode_of
from amberbox.diagnosis.fmea.findings import mapped
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.members import folders, members
from amberbox.diagnosis.fmea.model import Component, Fmea, FmeaTest, Function, Other
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.reading import Sheet, read
from amberbox.diagnosis.fmea.symptoms import Symptoms
from amberbox.diagnosis.fmea.testing import made_test

FILE = "fmea.yaml"
"""Its name in a robot folder."""


def load_fmea(path: str | Path, known: Known | None = None) -> tuple[Fmea | None, list[Problem]]:
    """Read a file; return the analysis (None if anything is wrong) and all problems and notes.

    Without ``known``, symptoms are not compared with what monitors the robot has.
    """
    problems: list[Problem] = []
    node = load_yaml(Path(path), problems)
    return _loaded(node, known, problems, Path(path).parent)


def read_fmea(
    text: str, known: Known | None = None, name: str = FILE
) -> tuple[Fmea | None, list[Problem]]:
    """Read the text of a file as ``load_fmea`` does; ``name`` is its name in messages."""
    problems: list[Problem] = []
    return _loaded(parse_yaml(text, name, problems), known, problems, Path())


def _loaded(
    node: Node | None, known: Known | None, problems: list[Problem], folder: Path
) -> tuple[Fmea | None, list[Problem]]:
    fmea = _made(node, known, problems, folder) if node is not None else None
    found = _each_once(problems)
    return (None if any(p.is_error for p in found) else fmea), found


def _made(root: Node, known: Known | None, problems: list[Problem], folder: Path) -> Fmea | None:
    sheet = read(root, known, problems)
    symptoms = _symptoms(sheet, known, problems)
    scope = Scope(sheet.file, symptoms, _tests(sheet, symptoms), problems)
    for part in sheet.parts:
        for name in part.modes:
            mode_of(part, name, scope)
    functions = {
        name: function_of(name, entry, child(root, "functions", name), scope)
        for name, entry in sheet.functions.items()
    }
    components = {part.component: component_of(part) for part in sheet.parts}
    components |= members(sheet.robots, root, scope, folder)
    components |= _of_folder(components, functions, sheet)
    file = sheet.file.other
    other = Other(file.probability, file.detects, file.looks_like, file.together_s)
    fmea = Fmea(
        sheet.file.description, scope.modes, components, functions, symptoms.found, scope.tests,
        other, sheet.file.exposure_h, mapped(sheet, scope.modes, known, problems),
        folders(sheet.robots, folder), sheet.file.remember_s,
    )  # fmt: skip
    return check(fmea, sheet, known, problems)


def _of_folder(
    components: Mapping[str, Component], functions: Mapping[str, Function], sheet: Sheet
) -> dict[str, Component]:
    """Return the components without an entry that something needs, directly or not.

    One in a circle, which a monitor may judge in the folder, is taken to need nothing.
    """
    users = {name: component.needs for name, component in components.items()}
    users |= {name: function.needs for name, function in functions.items()}
    found: dict[str, Component] = {}
    waiting = [name for needs in users.values() for name in needs.names()]
    while waiting:
        name = waiting.pop()
        if name in sheet.folder and name not in found:
            found[name] = Component(name, "", needs=sheet.folder[name])
            waiting += sheet.folder[name].names()
    while circle := _first_circle(users | {name: of.needs for name, of in found.items()}, found):
        found |= {name: Component(name, "") for name in circle}
    return found


def _first_circle(needs: Mapping[str, Needs], among: Mapping[str, Component]) -> list[str]:
    """Return which of some components lie on a circle of needs; none if there is no such circle."""
    parts = ([name for name in circle if name in among] for circle in cycles(needs))
    return next(filter(None, parts), [])


def _symptoms(sheet: Sheet, known: Known | None, problems: list[Problem]) -> Symptoms:
    symptoms = Symptoms(sheet.file.defaults, known, problems)
    symptoms.add(sheet.symptoms, child(sheet.root, "symptoms"), "symptoms")
    for part in sheet.parts:
        where, place = f"types.{part.type}.symptoms", child(part.node, "symptoms")
        symptoms.add(part.symptoms, place, where, part.component)
    return symptoms


def _tests(sheet: Sheet, symptoms: Symptoms) -> Mapping[str, FmeaTest]:
    tests = {
        name: made_test(name, entry, child(sheet.root, "tests", name), symptoms)
        for name, entry in sheet.tests.items()
    }
    for part in sheet.parts:
        for name, entry in part.tests.items():
            test_id = f"{part.component}.{name}"
            tests[test_id] = made_test(test_id, entry, child(part.node, "tests", name), symptoms)
    return tests


def _each_once(problems: list[Problem]) -> list[Problem]:
    """Keep one of the problems that all instances of a type share, in the order of the file."""
    kept: dict[tuple[str, int, str], Problem] = {}
    for problem in problems:
        kept.setdefault((problem.file, problem.line, problem.where), problem)
    return sorted(kept.values(), key=lambda problem: (problem.file, problem.line))
