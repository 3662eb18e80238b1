"""From ``fmea.yaml`` to the analysis as it is used; everything wrong is said at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from amberbox.core.config import build, parse_yaml
from amberbox.core.errors import Problem
from amberbox.core.needs import NOTHING, Needs, parse_needs
from amberbox.core.nodes import Node, load_yaml
from amberbox.diagnosis.fmea.checking import check
from amberbox.diagnosis.fmea.entries import Part, Scope, component_of, function_of, mode_of
from amberbox.diagnosis.fmea.file import FmeaFile, TypeFile
from amberbox.diagnosis.fmea.known import Known
from amberbox.diagnosis.fmea.members import members
from amberbox.diagnosis.fmea.model import Fmea, FmeaTest, Other
from amberbox.diagnosis.fmea.places import child
from amberbox.diagnosis.fmea.symptoms import Symptoms
from amberbox.diagnosis.fmea.testing import made_test
from amberbox.diagnosis.fmea.writing_out import Instance, instances

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
    file = build(FmeaFile, root, problems)
    found = instances(root, problems)
    parts = _parts(found, root, known, problems)
    if file is None:
        return None
    symptoms = Symptoms(file, known, problems)
    symptoms.add(file.symptoms, child(root, "symptoms"), "symptoms")
    for part in parts:
        where, place = f"types.{part.type}.symptoms", child(part.node, "symptoms")
        symptoms.add(part.file.symptoms, place, where, part.component)
    tests = _tests(file, parts, root, symptoms)
    scope = Scope(file, symptoms, tests, problems)
    for part in parts:
        for name in part.file.failure_modes:
            mode_of(part, name, scope)
    functions = {
        name: function_of(name, entry, child(root, "functions", name), scope)
        for name, entry in file.functions.items()
    }
    components = {part.component: component_of(part) for part in parts}
    components |= members(file, root, scope, folder)
    fmea = Fmea(
        file.description,
        scope.modes,
        components,
        functions,
        symptoms.found,
        tests,
        Other(file.other.probability, file.other.detects),
        file.exposure_h,
    )
    names = {*components, *functions, *(entry.component for entry in found)}
    return check(fmea, root, parts, names, problems)


def _parts(
    found: Sequence[Instance], root: Node, known: Known | None, problems: list[Problem]
) -> list[Part]:
    """Read the types, once for each of their components.

    Of what component files say that is needed, what the file does not have is left out.
    """
    parts = []
    names = {entry.component for entry in found} | set(child(root, "functions").mapping or ())
    inherited = {
        name: Needs(len(kept), kept)
        for name, needs in (known.needs if known else {}).items()
        if (kept := tuple(needed for needed in needs.names() if needed in names))
    }
    for entry in found:
        where = f"types.{entry.type}"
        file = build(TypeFile, entry.node, problems, where)
        if file is not None:
            needs = _needs(entry.node, inherited.get(entry.component, NOTHING), problems, where)
            parts.append(Part(entry.component, entry.type, file, entry.node, needs))
    return parts


def _needs(node: Node, inherited: Needs, problems: list[Problem], where: str) -> Needs:
    """Return what the type says that it needs, else what the component's own file says."""
    entry = (node.mapping or {}).get("needs")
    if entry is None:
        return inherited
    return parse_needs(entry, problems, f"{where}.needs", may_be_empty=True) or NOTHING


def _tests(
    file: FmeaFile, parts: list[Part], root: Node, symptoms: Symptoms
) -> Mapping[str, FmeaTest]:
    tests = {
        name: made_test(name, entry, child(root, "tests", name), symptoms)
        for name, entry in file.tests.items()
    }
    for part in parts:
        for name, entry in part.file.tests.items():
            test_id = f"{part.component}.{name}"
            tests[test_id] = made_test(test_id, entry, child(part.node, "tests", name), symptoms)
    return tests


def _each_once(problems: list[Problem]) -> list[Problem]:
    """Keep one of the problems that all instances of a type share, in the order of the file."""
    kept: dict[tuple[str, int, str], Problem] = {}
    for problem in problems:
        kept.setdefault((problem.file, problem.line, problem.where), problem)
    return sorted(kept.values(), key=lambda problem: (problem.file, problem.line))
