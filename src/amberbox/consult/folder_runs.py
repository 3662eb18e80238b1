"""Experiments and unit tests of a robot folder, as its failure modes can name them; none is run."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

from amberbox.core.types import RunKind
from amberbox.core.yaml_nodes import load_yaml
from amberbox.diagnosis.fmea.model import RunFacts
from amberbox.experiments import action, unit_tests
from amberbox.experiments.experiment import FOLDER as EXPERIMENTS
from amberbox.experiments.profile import Experiment, list_experiments, read_experiment

_FILE_NAMES = ("test_*.py", "*_test.py")


def folder_runs(folder: Path, kind: RunKind) -> Mapping[str, RunFacts]:
    """Return the experiments or unit tests of a robot folder, by name. No code in it is run."""
    return _experiments(folder) if kind == "experiment" else _unit_tests(folder)


def runs_of_copy(folder: Path, kind: RunKind) -> Mapping[str, RunFacts] | None:
    """Return the same of a copy of the folder, which has no unit tests: they are not known."""
    return _experiments(folder) if kind == "experiment" else None


def _experiments(folder: Path) -> Mapping[str, RunFacts]:
    moving = set(_moving_actions(folder))
    drafts = (
        read_experiment(path, draft=True)[0] for path in list_experiments(folder / EXPERIMENTS)
    )
    return {
        one.name: RunFacts(one.options.duration, not moving.isdisjoint(_actions(one)))
        for one in drafts if one is not None
    }  # fmt: skip


def _actions(experiment: Experiment) -> Iterator[str]:
    """Yield the actions that an experiment carries out, also in those that it calls."""
    yield from (step.action for step in experiment.robot_steps.values())
    for called in experiment.called.values():
        yield from _actions(called)


def _moving_actions(folder: Path) -> Iterator[str]:
    """Yield the actions that move something, by the text of their files: no plugin is loaded."""
    for path in sorted((folder / action.FOLDER).glob("*.yaml")):
        node = load_yaml(path, [])
        for name, entry in ((node.mapping if node else None) or {}).items():
            risk = (entry.mapping or {}).get("risk")
            if risk is not None and risk.value == "moves":
                yield name


def _unit_tests(folder: Path) -> Mapping[str, RunFacts]:
    """Return the unit tests by the text of their files, named as they are when pytest runs them."""
    nodes: dict[str, RunFacts] = {}
    for path in unit_tests.files_of(folder):
        if any(path.match(pattern) for pattern in _FILE_NAMES):
            file = path.relative_to(folder).as_posix()
            nodes |= {f"{file}::{name}": facts for name, facts in _tests_in(path)}
    return dict(zip(unit_tests.names_of(list(nodes)), nodes.values(), strict=True))


def _tests_in(path: Path) -> Iterator[tuple[str, RunFacts]]:
    """Yield the tests of a file; none of one that is no Python, which its own check reports."""
    try:
        body = ast.parse(path.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return
    for node in body:
        if isinstance(node, ast.ClassDef) and node.name.startswith("Test"):
            of_class = [ast.unparse(mark) for mark in node.decorator_list]
            inside = (one for one in node.body if isinstance(one, ast.FunctionDef))
            yield from (
                (f"{node.name}::{one.name}", _facts(one, of_class))
                for one in inside if one.name.startswith("test")
            )  # fmt: skip
        elif isinstance(node, ast.FunctionDef) and node.name.startswith("test"):
            yield node.name, _facts(node, [])


def _facts(test: ast.FunctionDef, of_class: list[str]) -> RunFacts:
    marks = [*of_class, *(ast.unparse(mark) for mark in test.decorator_list)]
    return RunFacts(
        moves="pytest.mark.risk('moves')" in marks,
        parametrised=any(mark.startswith("pytest.mark.parametrize(") for mark in marks),
    )
