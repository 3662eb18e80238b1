"""Operations of worker processes on the models in a robot's folder: structure and consistency.

Nothing of a folder is run, and each search ends after its time, with what was found so far.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from amberbox.core.clock import NS
from amberbox.core.contracts import Budget
from amberbox.core.equations.generator import generator_of
from amberbox.core.equations.model_file import load_equations, load_model
from amberbox.core.errors import AmberboxError, Problem, UsageError, did_you_mean
from amberbox.core.timestamps import format_time
from amberbox.core.yaml_nodes import only_below
from amberbox.detection.residuals import size_curve
from amberbox.diagnosis.consistency.answers import answer_json, components_json, question_about
from amberbox.diagnosis.consistency.question import ask
from amberbox.diagnosis.models import ModelKind, find_model, read_models
from amberbox.diagnosis.structure.answers import faults_json, sets_json
from amberbox.diagnosis.structure.decomposition import matrix_json
from amberbox.server.knowledge.questions import (
    AskConsistency,
    AskModel,
    AskResidual,
    AskStructure,
    RobotQuestion,
    decode_question,
)
from amberbox.server.knowledge.worker import (
    ends,
    json_operation,
    opened_stores,
    place_at,
    watched_hash,
)

_MOST_PROBLEMS = 20

Asked = TypeVar("Asked", bound=RobotQuestion)


@json_operation
def listed(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the files of a robot's ``models/``, and what is wrong with each."""
    place, _ = _asked(folder, arguments, RobotQuestion)
    return _listed(place)


@lru_cache(maxsize=16)
def _listed(place: Path) -> list[dict[str, Any]]:
    """Return the list of a folder, cached per worker: the content behind a hash never changes."""
    with only_below(place):
        found, others = read_models(place)
        wrong: list[tuple[str, str, list[Problem]]] = [
            (model.name, model.kind, model.problems()) for model in found
        ]
    wrong += [(Path(problem.file).stem, "", [problem]) for problem in others if problem.is_error]
    return [
        {"name": name, "kind": kind, "problems": list(_shown(problems))}
        for name, kind, problems in wrong
    ]


def _shown(problems: Sequence[Problem]) -> Iterator[str]:
    errors = [problem for problem in problems if problem.is_error]
    yield from map(str, errors[:_MOST_PROBLEMS])
    if len(errors) > _MOST_PROBLEMS:
        yield f"and {len(errors) - _MOST_PROBLEMS:,} more"


@json_operation
def structure(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return what a model of equations can show."""
    place, asked = _asked(folder, arguments, AskStructure)
    path, about = _model(place, asked, "equations")
    with only_below(place):
        if asked.show == "residuals":
            return {**about, "residuals": [*_residuals(path)], "incomplete": ""}
        model = load_equations(path)
    budget = Budget(is_over=ends(asked.seconds))
    if asked.show == "matrix":
        return {**about, **matrix_json(model), "incomplete": ""}
    if asked.show == "faults":
        return {**about, **faults_json(model, asked.causality, budget)}
    measurable, most = asked.measurable, asked.most
    return {
        **about,
        **sets_json(model, asked.show, budget, most, measurable, fallible=asked.fallible),
    }


MOST_NS = 6 * 3600 * NS
"""Time over which the size of a residual can be asked for at once."""


@json_operation
def residual(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the size of a residual over time; raises UsageError if it cannot be computed."""
    place, asked = _asked(folder, arguments, AskResidual)
    path, about = _model(place, asked, "equations")
    if not 0 <= asked.to_ns - asked.from_ns <= MOST_NS:
        raise UsageError(
            f"a residual is computed over at most {MOST_NS // NS // 3600} h", "name a shorter range"
        )
    with only_below(place):
        model = load_model(path)
    if asked.residual not in model.residuals:
        near = did_you_mean(asked.residual, model.residuals)
        raise UsageError(f"the model has no residual '{asked.residual}'{near}")
    generator = generator_of(model, asked.residual)
    record = opened_stores(folder).archive.robot(asked.robot)
    span = asked.from_ns, asked.to_ns
    curve = size_curve(record, generator, span, asked.points, Budget(is_over=ends(asked.seconds)))
    is_cut = curve.until_ns < asked.to_ns
    return {
        **about, "residual": asked.residual, "threshold": generator.options.threshold,
        "step_s": curve.step_ns / NS, "of": curve.of,
        "times": [format_time(at_ns) for at_ns in curve.times_ns.tolist()],
        "sizes": [None if size != size else size for size in curve.sizes.tolist()],
        "incomplete": f"the time was up at {format_time(curve.until_ns)}" if is_cut else "",
    }  # fmt: skip


def _residuals(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the residuals of a model, and why one cannot be computed."""
    model = load_model(path)
    for name, options in model.residuals.items():
        known: dict[str, Any] = {"checks": options.checks, "components": [], "reads": []}
        problem = ""
        try:
            generator = generator_of(model, name)
            known = {
                "checks": generator.checks, "components": [*generator.components],
                "reads": [*generator.addresses],
            }  # fmt: skip
        except AmberboxError as error:
            problem = error.what
        yield {"name": name, "threshold": options.threshold, **known, "problem": problem}


@json_operation
def consistency(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return which modes of a model of components agree with observations."""
    return _consistency(*_asked(folder, arguments, AskConsistency))


def _consistency(place: Path, asked: AskConsistency) -> dict[str, Any]:
    path, about = _model(place, asked, "components")
    budget = Budget(is_over=ends(asked.seconds))
    with only_below(place):
        question = question_about(path, asked.observe, budget)
    return {**about, **answer_json(ask(question, asked.minimal, asked.most, budget))}


@json_operation
def components(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the parts of a model of components, and the answer if anything was observed."""
    place, asked = _asked(folder, arguments, AskConsistency)
    path, about = _model(place, asked, "components")
    with only_below(place):
        shown = components_json(path)
    seen = bool(asked.observe or shown["steps"])
    return {**about, **shown, "answer": _consistency(place, asked) if seen else None}


def _asked(folder: Path, arguments: dict[str, Any], kind: type[Asked]) -> tuple[Path, Asked]:
    """Return where the robot's folder is, and the question."""
    asked, stores = decode_question(arguments, kind), opened_stores(folder)
    watched = watched_hash(stores, asked)
    return place_at(folder, stores.database, asked.robot, asked.config_hash, watched), asked


def _model(place: Path, asked: AskModel, kind: ModelKind) -> tuple[Path, Mapping[str, Any]]:
    """Return the file of a model, and what each answer begins with."""
    with only_below(place):
        found = find_model(place, kind, asked.model)
    about = {"robot": asked.robot, "config_hash": place.name, "model": found.name}
    return found.path, about
