"""Models of a robot folder: ``models/NAME.yaml`` of equations or of components, and fault trees.

All ``models/NAME.xml`` together are one model in the Open-PSA Model Exchange Format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from amberbox.core.config import raise_errors
from amberbox.core.equations.model_file import load_equations
from amberbox.core.errors import ConfigurationError, Problem, UsageError, did_you_mean
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.core.yaml_nodes import Node, load_yaml
from amberbox.diagnosis.consistency.components import load_components
from amberbox.diagnosis.faulttree.open_psa import read_mef_trees
from amberbox.diagnosis.faulttree.tree import FaultTree

FOLDER = "models"
MOST_MODELS = 100
MOST_BYTES = 2_000_000  # of one file
LONGEST_TEXT = 1_000  # of a name, or any other text in a file

ModelKind: TypeAlias = Literal["components", "equations"]
KINDS: tuple[ModelKind, ...] = get_args(ModelKind)
_LOADERS: Mapping[ModelKind, Callable[[Path], object]] = {
    "components": load_components,
    "equations": load_equations,
}
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,63}")


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A file of ``models/``, by what it is made of and its name without suffix."""

    kind: ModelKind
    name: str
    path: Path

    def problems(self) -> list[Problem]:
        """Return everything that is wrong in the file."""
        try:
            _LOADERS[self.kind](self.path)
        except ConfigurationError as error:
            return list(error.problems)
        return []


def models_of(folder: Path) -> Mapping[ModelKind, Mapping[str, Path]]:
    """Return the files of all models of a robot folder, by kind and name.

    Files that are no models are left out; the others are not checked further.
    """
    found, _ = read_models(folder)
    return {kind: {one.name: one.path for one in found if one.kind == kind} for kind in KINDS}


def read_models(folder: Path) -> tuple[list[ModelFile], list[Problem]]:
    """Return the models of a robot folder by kind and name, and what is wrong with other files.

    Only the kind of each file is read: ``ModelFile.problems`` checks the rest.
    """
    place = folder / FOLDER
    paths = sorted(path for path in place.glob("*.yaml") if not path.name.startswith("."))
    problems: list[Problem] = []
    if len(paths) > MOST_MODELS:
        what = f"has {len(paths)} models; at most {MOST_MODELS} are allowed"
        return [], [Problem(str(place), 1, "folder", what)]
    read = (_read(path, problems) for path in paths)
    found = [model for model in read if model is not None]
    return sorted(found, key=lambda model: (model.kind, model.name)), problems


def find_model(folder: Path, kind: ModelKind, name: str = "") -> ModelFile:
    """Return a model of a robot folder; without ``name`` its only one of this kind.

    Raises UsageError if there is none, or which one is not said. With a name no other file is read.
    """
    named = folder / FOLDER / f"{name}.yaml"
    model = _read(named, []) if _NAME.fullmatch(name) and named.is_file() else None
    if model is not None and model.kind == kind:
        return model
    files = models_of(folder)[kind]
    what = f"there is no model of kind: {kind}"
    if not files:
        raise UsageError(what, f"write {FOLDER}/NAME.yaml; 'amberbox check' reads it")
    listed = f"models of kind {kind}: {', '.join(files)}"
    if name:
        raise UsageError(f"{what} called '{name}'{did_you_mean(name, files)}", listed)
    if len(files) > 1:
        raise UsageError(f"there are {len(files)} models of kind: {kind}: which one?", listed)
    [(name, path)] = files.items()
    return ModelFile(kind, name, path)


def trees_of(folder: Path) -> dict[str, FaultTree]:
    """Return the fault trees in the files of a robot folder, by their top gate.

    Raises ConfigurationError with everything that is wrong in them.
    """
    paths = sorted(path for path in (folder / FOLDER).glob("*.xml") if path.name[0] != ".")
    if len(paths) > MOST_MODELS:
        what = f"has {len(paths)} fault tree files; at most {MOST_MODELS} are allowed"
        raise ConfigurationError([Problem(str(folder / FOLDER), 1, "folder", what)])
    refused = [(path, _tree_refusal(folder, path)) for path in paths]
    raise_errors([Problem(str(path), 1, "file", why) for path, why in refused if why])
    return {tree.top: tree for tree in read_mef_trees(paths)} if paths else {}


def _tree_refusal(folder: Path, path: Path) -> str:
    if not path.resolve().is_relative_to(folder.resolve()):
        return "lies outside of the folder, and is not read"
    if not path.is_file():
        return "is no file"
    size = path.stat().st_size
    return f"has {size:,} bytes; at most {MOST_BYTES:,} are read" if size > MOST_BYTES else ""


def check_models(folder: Path) -> tuple[list[ModelFile], list[Problem]]:
    """Return the models of a robot folder without an error, and all problems of its models."""
    found, problems = read_models(folder)
    wrong = {model.path: model.problems() for model in found}
    every = [*problems, *(problem for some in wrong.values() for problem in some)]
    try:
        trees_of(folder)
    except ConfigurationError as error:
        every += error.problems
    every.sort(key=lambda problem: (problem.file, problem.line))
    return [model for model in found if not any(p.is_error for p in wrong[model.path])], every


def unknown_modes(models: Sequence[ModelFile], failure_modes: Collection[str]) -> Iterator[Problem]:
    """Yield a problem for each failure mode in ``maps_to`` that the FMEA does not have."""
    known = [*failure_modes, UNKNOWN_FAULT]
    for model in models:
        root = load_yaml(model.path, []) if model.kind == "components" else None
        maps_to = (root.mapping or {}).get("maps_to") if root is not None else None
        for fault, meant in ((maps_to.mapping if maps_to is not None else None) or {}).items():
            for mode in meant.items or ():
                if mode.text not in known:
                    near = did_you_mean(mode.text, known)
                    what = f"there is no failure mode '{mode.text}' in fmea.yaml{near}"
                    yield mode.problem(f"maps_to.{fault}", what, "write component#mode")


def _read(path: Path, problems: list[Problem]) -> ModelFile | None:
    refusal = _refusal(path)
    if refusal:
        problems.append(Problem(str(path), 1, "file", refusal))
        return None
    root = load_yaml(path, problems)
    node = (root.mapping or {}).get("kind") if root is not None else None
    if root is not None and node is None:
        what = f"is no model and not used: it has no kind ({' or '.join(KINDS)})"
        problems.append(root.problem("file", what, is_error=False))
    if root is None or node is None:
        return None
    long = next((one for one in _texts(root) if len(one.text) > LONGEST_TEXT), None)
    if long is not None:
        what = f"a text has {len(long.text):,} characters; at most {LONGEST_TEXT:,} are read"
        problems.append(long.problem("file", what))
        return None
    kind = _kind(node)
    if kind is None:
        near = did_you_mean(node.text, KINDS)
        what = f"there are no models of kind '{node.text[:40]}'{near}"
        problems.append(node.problem("kind", what, f"kinds of models: {', '.join(KINDS)}"))
        return None
    return ModelFile(kind, path.stem, path)


def _refusal(path: Path) -> str:
    """Return why a file is not read; empty for one that is."""
    if not _NAME.fullmatch(path.stem):
        return "its name is no name of a model: letters, digits, _ . and -, at most 64"
    if not path.is_file():
        return "is no file"
    size = path.stat().st_size
    return f"has {size:,} bytes; at most {MOST_BYTES:,} are read" if size > MOST_BYTES else ""


def _texts(node: Node) -> Iterator[Node]:
    """Yield all texts and keys of a file."""
    if node.mapping is None and node.items is None:
        yield node
    for one in node.items or ():
        yield from _texts(one)
    for key, one in (node.mapping or {}).items():
        yield replace(one, value=None, text=key)
        yield from _texts(one)


def _kind(node: Node) -> ModelKind | None:
    return next((kind for kind in KINDS if node.value == kind), None)
