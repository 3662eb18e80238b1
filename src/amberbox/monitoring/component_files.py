"""Component and mode files: their paths, their keys, and the monitor function they name.

``read_tree`` finds the files below ``components/``; the option classes are their keys (the paper's
listings 4 and 5); ``find_functions`` and ``function_of`` resolve ``monitor:`` to a mode or probe of
Amberbox or of the robot folder.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from amberbox.core import plugins
from amberbox.core.errors import AmberboxError, Problem, did_you_mean
from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.core.robot_status import Severity
from amberbox.core.yaml_nodes import Node, load_yaml
from amberbox.monitoring.plan import Policy

FOLDER = "components"
RECOVERY_FILE = "recovery_config.yaml"
RULE_TESTS = ".test.yaml"
_OF_COMPONENTS = frozenset(
    {"component_name", "modes", "dependencies", "dependency_monitors", "recovery_actions"}
)
_OF_MODES = frozenset({"mappings", "monitor", "arguments", "states", "stale_after"})


@dataclass(frozen=True)
class ModeSource:
    """A mode file; ``node`` is None if it cannot be read, ``problem`` is the reason."""

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
        """Return its name, or that of its file where it gives none."""
        keys = self.node.mapping or {}
        given = keys.get("component_name", keys.get("name"))
        return given.text.strip() if given is not None and given.text.strip() else self.path.stem


@dataclass(frozen=True)
class ComponentTree:
    """All of ``components/``; ``unlisted`` are mode files that no component lists."""

    components: tuple[ComponentSource, ...] = ()
    unlisted: tuple[ModeSource, ...] = ()
    recovery: Node | None = None


def read_tree(folder: Path, problems: list[Problem]) -> ComponentTree:
    """Read all YAML files below ``folder``; their errors are added to ``problems``."""
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
    return ComponentTree(components, unlisted, recovery)


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
        """Return the contents of a file; None if its syntax is wrong."""
        if path not in self._nodes:
            self._nodes[path] = load_yaml(path, self.problems)
        return self._nodes[path]

    def kind(self, path: Path) -> str:
        """Return the kind of a file by its keys."""
        node = self.node(path)
        if node is None or path.name == RECOVERY_FILE:
            return "recovery" if node else ""
        keys = frozenset(node.mapping or {})
        if keys & _OF_MODES and "component_name" not in keys:
            return "mode"
        if keys & _OF_COMPONENTS:
            return "component"
        self._report_unknown(node, keys)
        return ""

    def _report_unknown(self, node: Node, keys: frozenset[str]) -> None:
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
        near = did_you_mean(
            entry.text,
            [Path(os.path.relpath(known, path.parent)).as_posix() for known in self._nodes],
        )
        what = f"there is no mode file '{entry.text}'{near}"
        self.problems.append(entry.problem(where, what))
        return ModeSource(_plain(path.parent / entry.text), None, what)


# reserved: no fault state may have one of these names
STATES = ("nominal", "unknown", "stale", "not_initialised", "not_monitored")

OutputType = Literal["bool", "int", "float", "double", "string"]

# path of a key, without places in lists: the note shown for it
LEGACY_KEYS: Mapping[str, str] = {
    "monitor_name": "ignored: the mode files say which monitors there are",
    "mappings.map_outputs": "ignored: outputs are bound by name, by 'result:', or in order",
}


def legacy_note(path: str) -> str | None:
    """Return the note for a key of older files, None for a key that was never known."""
    return LEGACY_KEYS.get(path)


@dataclass(frozen=True)
class FlappingOptions:
    """The limits from which changes of an output count as flapping."""

    changes: int = option(6, "more changes than this")
    within: float = option(60.0, "in this time", unit="s")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        for key in ("changes", "within"):
            if getattr(self, key) <= 0:
                yield key, "must be above 0"


@dataclass(frozen=True)
class OutputOptions:
    """One output of a mode: its name and type, its expected value, and its severity."""

    name: str = option(doc="name of the output")
    type: OutputType = option(doc="what its values are")
    expected: Any = option(None, "what it should be: a value, '>= 50', '2 .. 8', {min: 2, max: 8}")
    result: str = option("", "result of the monitor that it shows; else by name, else by type")
    unit: str = option("", "unit of its numbers, for people; else what the monitor says")
    severity: Severity = option("urgent", "what it means for the robot if it is not as expected")
    for_s: float = option(
        0.0, "how long it must be bad before it counts", unit="s", aliases=["for"]
    )
    heal_s: float = option(
        0.0, "how long it must be good before it is healed", unit="s", aliases=["heal"]
    )
    flapping: FlappingOptions = option(FlappingOptions(), "when it is called flapping")
    description: str = option("", "what it is, for people")
    hint: str = option("", "what to do if it is not as expected")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        if not self.name.strip() or any(sign in self.name.strip() for sign in "/ \t:#"):
            yield "name", f"'{self.name}' cannot be part of an address: leave out blanks and / : #"
        if self.name.strip() in STATES:
            yield "name", f"'{self.name}' is a state of its own; faults are called after outputs"
        for key in ("for_s", "heal_s"):
            if not 0 <= getattr(self, key) < float("inf"):
                yield key, "must be 0 or more"


@dataclass(frozen=True)
class MappingOptions:
    """Inputs of a mode, and the outputs made from them."""

    inputs: Sequence[str] = option((), "items, variables, topics, or subjects of probes")
    outputs: Sequence[OutputOptions] = option((), "what is found out")


@dataclass(frozen=True)
class ModeFileOptions:
    """Everything in a mode file (the paper's listing 5)."""

    name: str = option("", "name of the mode, 'monitorName' in messages; the file's name without")
    monitor: str = option("", "function that it is; told from the name without")
    description: str = option("", "what it watches, for people")
    mappings: Sequence[MappingOptions] = option((), "inputs and outputs")
    arguments: Mapping[str, Any] = option({}, "what the monitor wants to know")
    states: Mapping[str, Expression] = option({}, "fault states by name: conditions over outputs")
    stale_after: float | Literal["never"] | None = option(
        None, "after this long without a message of an input it is stale, or never", unit="s"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        for name in self.states:
            if name in STATES:
                yield "states", f"'{name}' is a state of its own: give the fault another name"
        if isinstance(self.stale_after, float | int) and not 0 < self.stale_after < float("inf"):
            yield "stale_after", "must be above 0, or never"


@dataclass(frozen=True)
class DependencyMonitorOptions:
    """The monitor that gives the state of a dependency, by dependency; ``none`` for no monitor."""

    heartbeat: Mapping[str, str] = option({}, "COMPONENT/MODE that says whether it is alive")
    functional: Mapping[str, str] = option({}, "COMPONENT/MODE that says whether it works")


@dataclass(frozen=True)
class ComponentFileOptions:
    """Everything in a component file (the paper's listing 4)."""

    component_name: str = option(doc="name of the component", aliases=["name"])
    description: str = option("", "what it is, for people")
    modes: Sequence[str] = option((), "mode files, seen from this file, then from components/")
    dependencies: Any = option((), "components that it needs: a list, or {any: [...]} and so on")
    dependency_monitors: DependencyMonitorOptions = option(
        DependencyMonitorOptions(), "which monitor speaks for a dependency"
    )
    recovery_actions: Sequence[str] = option(
        (), "what may help: an action with its parameters, or text"
    )
    part_of: str = option("", "component that it is a part of")
    policy: Policy = option("all", "how many of its modes must be ok: all, any or majority")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each invalid value, and the reason."""
        if not self.component_name.strip():
            yield "component_name", "must not be empty"


@dataclass(frozen=True)
class RecoveryOptions:
    """One entry of ``recovery_config.yaml``: the restarts of the predecessor, and their
    conditions.
    """

    monitor: str = option(doc="COMPONENT/MODE that tells the fault")
    monitored_parameter: str = option("", "output of it")
    restart: str = option("", "unit to restart")
    component_type: str = option("", "how it is restarted, such as systemd")
    recover_children: bool = option(False, "whether what depends on it is restarted too")


MODES = "amberbox.monitoring.modes"
PROBES = "amberbox.monitoring.probes"
OWN_MODES = "modes"  # folder with the robot's own monitors, one file each
OWN_PROBES = "probes"
MODE_DEFINES = ("Config", "evaluate")
PROBE_DEFINES = ("MEASURES", "SUBJECT", "measure")
_ENDINGS = ("_monitor", "_functional")
_NEEDED = ("Config", "ACCEPTS", "RESULTS", "evaluate")


@dataclass(frozen=True)
class MonitorFunctions:
    """The available monitors and probes."""

    modes: Mapping[str, plugins.Plugin]
    probes: Collection[str]

    def load(self, name: str) -> ModuleType:
        """Import a monitor; raise AmberboxError if it cannot be, or does not keep the contract."""
        try:
            module = self.modes[name].load()
        except AmberboxError:
            raise
        except (Exception, SystemExit) as error:  # a robot's own monitor may fail in any way
            what = f"monitor '{name}' cannot be loaded: {type(error).__name__}: {error}"
            raise AmberboxError(what, f"look at {self.modes[name].path}") from error
        missing = [word for word in _NEEDED if not hasattr(module, word)]
        if missing:
            what = f"monitor '{name}' does not define {', '.join(missing)}"
            raise AmberboxError(what, f"look at {self.modes[name].path}")
        return module


def find_functions(folder: Path, *, own: bool = True) -> MonitorFunctions:
    """Find the monitors and probes: those of Amberbox, then the folder's own.

    Without ``own``, Python files of the folder are not read.
    """
    if not own:
        modes, probes = _shipped(MODES, MODE_DEFINES), _shipped(PROBES, PROBE_DEFINES)
        return MonitorFunctions(modes, frozenset(probes))
    modes = _found(MODES, folder / OWN_MODES, MODE_DEFINES)
    probes = _found(PROBES, folder / OWN_PROBES, PROBE_DEFINES)
    return MonitorFunctions(modes, frozenset(probes))


def _found(package: str, own: Path, defines: tuple[str, ...]) -> Mapping[str, plugins.Plugin]:
    return plugins.find(package, [own], defines) if own.is_dir() else _shipped(package, defines)


@lru_cache
def _shipped(package: str, defines: tuple[str, ...]) -> Mapping[str, plugins.Plugin]:
    """Find what does not change while the program runs; its files are read once."""
    return plugins.find(package, (), defines)


def short_name(name: str) -> str:
    """Return the name of a mode without ``_monitor`` and ``_functional``."""
    for ending in _ENDINGS:
        name = name.removesuffix(ending)
    return name


def function_of(name: str, known: Collection[str]) -> str | None:
    """Return the function that a mode's name means: its whole, else its longest known ending."""
    words = short_name(name).split("_")
    endings = ("_".join(words[start:]) for start in range(len(words)))
    return next((ending for ending in endings if ending in known), None)


def unknown_function(name: str, known: Sequence[str], *, is_key: bool) -> str:
    """Describe an unknown function, with the nearest name."""
    if is_key:
        return f"there is no monitor '{name}'{did_you_mean(name, known)}"
    near = did_you_mean(short_name(name).rpartition("_")[2], known)
    return f"no monitor goes by the name '{name}'{near}"
