"""The files below ``components/``: which are components, which modes, and what they hold."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.core.config import did_you_mean
from amberbox.core.errors import Problem
from amberbox.core.nodes import Node, load_yaml

FOLDER = "components"
RECOVERY_FILE = "recovery_config.yaml"
RULE_TESTS = ".test.yaml"
_OF_COMPONENTS = frozenset(
    {"component_name", "modes", "dependencies", "dependency_monitors", "recovery_actions"}
)
_OF_MODES = frozenset({"mappings", "monitor", "arguments", "states", "stale_after"})


@dataclass(frozen=True)
class ModeSource:
    """A mode file; ``node`` is None if it cannot be read, and ``problem`` says why."""

    path: Path
    node: Node | None
    problem: str = ""


@dataclass(frozen=True)
class ComponentSource:
    """A component file and the mode files that it lists."""

    path: Path
    node: Node
    modes: tuple[ModeSource, ...] = ()

    @property
    def name(self) -> str:
        """Its name, as far as it can be told."""
        keys = self.node.mapping or {}
        given = keys.get("component_name", keys.get("name"))
        return given.text.strip() if given is not None and given.text.strip() else self.path.stem


@dataclass(frozen=True)
class Tree:
    """All of ``components/``; ``unlisted`` are mode files that no component lists."""

    components: tuple[ComponentSource, ...] = ()
    unlisted: tuple[ModeSource, ...] = ()
    recovery: Node | None = None


def read_tree(folder: Path, problems: list[Problem]) -> Tree:
    """Read all YAML files below ``folder``; what is wrong with them goes to ``problems``."""
    files = _Files(folder, problems)
    paths = list(_paths(folder))
    kinds = {path: files.kind(path) for path in paths}
    components = tuple(
        ComponentSource(path, node, tuple(files.modes_of(path, node)))
        for path in paths
        if kinds[path] == "component" and (node := files.node(path)) is not None
    )
    listed = {mode.path for component in components for mode in component.modes}
    left = [path for path in paths if kinds[path] == "mode" and path not in listed]
    problems.extend(_not_listed(path) for path in left)
    unlisted = tuple(ModeSource(path, files.node(path)) for path in left)
    recovery = next((files.node(path) for path in paths if kinds[path] == "recovery"), None)
    return Tree(components, unlisted, recovery)


def _paths(folder: Path) -> Iterator[Path]:
    for path in sorted([*folder.rglob("*.yaml"), *folder.rglob("*.yml")]):
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if not hidden and not path.name.endswith(RULE_TESTS):
            yield _plain(path)


def _plain(path: Path) -> Path:
    return Path(os.path.normpath(path))


def _not_listed(path: Path) -> Problem:
    what = "no component lists this mode: it is checked, but not run"
    return Problem(str(path), 1, "file", what, is_error=False)


@dataclass
class _Files:
    """Reads each file once."""

    folder: Path
    problems: list[Problem]
    _nodes: dict[Path, Node | None] = field(default_factory=dict)

    def node(self, path: Path) -> Node | None:
        """Return what is in a file; None if its syntax is wrong."""
        if path not in self._nodes:
            self._nodes[path] = load_yaml(path, self.problems)
        return self._nodes[path]

    def kind(self, path: Path) -> str:
        """Tell what a file is by its keys."""
        node = self.node(path)
        if node is None or path.name == RECOVERY_FILE:
            return "recovery" if node else ""
        keys = frozenset(node.mapping or {})
        if keys & _OF_MODES and "component_name" not in keys:
            return "mode"
        if keys & _OF_COMPONENTS:
            return "component"
        self._tell_unknown(node, keys)
        return ""

    def _tell_unknown(self, node: Node, keys: frozenset[str]) -> None:
        if "config_dirs" in keys:
            what = "ignored: all files below components/ are read; robot.yaml names the robot"
            self.problems.append(node.problem("file", what, is_error=False))
            return
        hint = "component files have 'component_name:', mode files have 'mappings:'"
        what = "is neither a component nor a mode of one"
        self.problems.append(node.problem("file", what, hint))

    def modes_of(self, path: Path, node: Node) -> Iterator[ModeSource]:
        """Yield the modes that a component file lists."""
        entries = (node.mapping or {}).get("modes", node).items or ()
        for index, entry in enumerate(entries):
            if entry.text:
                yield self._mode(entry, f"modes[{index}]", path)

    def _mode(self, entry: Node, where: str, path: Path) -> ModeSource:
        """Find a mode file: seen from the component file first, then from ``components/``."""
        for folder in (path.parent, self.folder):
            place = _plain(folder / entry.text)
            if place.is_file():
                node = self.node(place)
                return ModeSource(place, node, "" if node else f"{place} cannot be read")
        near = did_you_mean(entry.text, [_seen_from(path, known) for known in self._nodes])
        what = f"there is no mode file '{entry.text}'{near}"
        self.problems.append(entry.problem(where, what))
        return ModeSource(_plain(path.parent / entry.text), None, what)


def _seen_from(path: Path, known: Path) -> str:
    return Path(os.path.relpath(known, path.parent)).as_posix()
