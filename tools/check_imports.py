"""Check the imports of docs/develop/design.md 2: directions, cycles, and what loads late."""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

from tools.findings import ROOT, Finding, report

OURS = "amberbox"
_UPPER = frozenset(
    {"core", "blackbox", "monitoring", "detection", "diagnosis", "consult", "experiments", "link"}
)
ALLOWED: Mapping[str, frozenset[str]] = {
    "core": frozenset(),
    "blackbox": frozenset({"core"}),
    "sim": frozenset({"core"}),
    "simbuses": frozenset({"core", "sim", "blackbox"}),
    "testing": frozenset({"core", "blackbox"}),
    "diagnosis": frozenset({"core"}),
    "monitoring": frozenset({"core", "blackbox"}),
    "detection": frozenset({"core", "blackbox"}),
    "consult": frozenset({"core", "blackbox", "monitoring", "diagnosis", "experiments"}),
    "experiments": frozenset({"core", "blackbox"}),
    "link": frozenset({"core", "blackbox"}),
    "client": frozenset({"core", "blackbox"}),
    "agent": _UPPER,
    "server": _UPPER,
    "demo": _UPPER | {"sim", "agent", "server", "client"},
    "cli": _UPPER | {"sim", "testing", "agent", "server", "client", "demo"},
    "": frozenset({"core", "blackbox", "client"}),
    "__main__": frozenset({"cli", "core"}),
}
"""Which of our packages each may import, besides itself; "" is the package's front door."""

SOURCES = f"{OURS}.blackbox.sources"
PROTOCOLS = tuple(
    f"{OURS}.{name}"
    for name in (
        "blackbox.sources.ros1",
        "blackbox.sources.ros2_transports",
        "blackbox.formats",
        "blackbox.canbus",
        "blackbox.ethercat",
        "blackbox.payloads",
        "blackbox.sources.zre",
        "sim",
    )
)
"""Protocol libraries of our own: what a source may import besides ``core``."""

MODES = f"{OURS}.monitoring.modes"
PROBES = f"{OURS}.monitoring.probes"
ROS1 = f"{OURS}.blackbox.sources.ros1"
ROS2 = f"{OURS}.blackbox.sources.ros2_transports"
EVIDENCE = f"{OURS}.diagnosis.evidence"
ACTIONS = f"{OURS}.experiments.actions"
DETECTORS = f"{OURS}.detection.detectors"
SIM_BUSES = f"{OURS}.simbuses"
REASONING = tuple(
    f"{OURS}.diagnosis.{name}"
    for name in (
        "covering",
        "diagnose",
        "faulttree",
        "fmea",
        "knowledge",
        "consistency",
        "models",
        "prolog",
        "symptom_sizes",
    )
)
"""What a provider of evidence may import: the model, and libraries of its method."""

METHODS = tuple(
    f"{OURS}.detection.{name}"
    for name in (
        "channels",
        "clusters",
        "features",
        "kalman",
        "learnt_options",
        "limits",
        "schedule",
        "transitions",
    )
)
"""What a detector may import: nouns and methods that detectors share."""

PLUGINS: Mapping[str, tuple[str, Sequence[str]]] = {
    SOURCES: ("source", PROTOCOLS),
    MODES: ("mode", ()),
    PROBES: ("probe", (ROS1, ROS2)),
    EVIDENCE: ("provider of evidence", REASONING),
    ACTIONS: ("action", (ROS1,)),
    DETECTORS: ("detector", METHODS),
    SIM_BUSES: ("bus of the simulated robot", (ROS1, f"{OURS}.sim")),
}
"""Packages of plugins: what one is called, and what it may import besides ``core``."""

READERS: Mapping[str, Sequence[str]] = {
    f"{SOURCES}.status": tuple(f"{OURS}.blackbox.{name}" for name in ("journal.channels", "store")),
    f"{SOURCES}.ros1": tuple(
        f"{OURS}.blackbox.columns.{name}" for name in ("ros1_text", "ros_definition")
    ),
    f"{SOURCES}.ros2_transports": tuple(
        f"{OURS}.blackbox.columns.{name}" for name in ("ros2_types", "ros_definition")
    ),
}
"""What single plugins may import besides: our own record, for the statuses that a robot's watcher
wrote; the definitions of ROS messages, for the protocols of ROS 1 and 2."""

HEAVY = frozenset({"pyarrow", "duckdb", "zmq", "matplotlib", "pandas", "polars", "tsdownsample"})
RECORDING = tuple(
    f"{OURS}.{name}"
    for name in (
        "core",
        "sim",
        "blackbox.sources",
        "blackbox.filters",
        "blackbox.columns.unroll",
        "blackbox.recorder",
        "blackbox.journal",
    )
)
"""The record process: where pyarrow must not be imported at all."""


def check(source: Path) -> list[Finding]:
    """Return every import below ``source`` that the directions forbid, and cycles of imports."""
    known = modules(source)
    graph = {module: imports(module, path, known) for module, path in known.items()}
    return [
        Finding(_shown(known[module], source), entry.line, f"{module} {what}")
        for module, entries in graph.items()
        for entry in entries
        for what in _complaints(module, entry)
    ] + [*_pyarrow_in_record(graph, known, source), *_cycles(known, source)]


def _cycles(known: Mapping[str, Path], source: Path) -> Iterator[Finding]:
    """Find a cycle among all files, then among what lies in each folder; every import counts.

    Imports in functions and for type checkers count too: a reader follows them as well.
    """
    files: dict[str, set[str]] = {}
    folders: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for module, path in known.items():
        entries = imports(module, path, known, typing=True)
        files[module] = {e.target for e in entries if e.target in known} - {module}
        for target in files[module]:
            folder, ours, theirs = _fork(_file(module, known), _file(target, known))
            folders[folder][ours].add(theirs)
    for folder, graph in (("files", files), *sorted(folders.items())):
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            cycle = " <- ".join(error.args[1])
            where = "src" if folder == "files" else str(source.joinpath(*folder.split(".")))
            yield Finding(where, 0, f"a cycle of imports: {cycle}")


def _file(module: str, known: Mapping[str, Path]) -> Sequence[str]:
    """Return the parts of a module's name; those of a package end with ``__init__``."""
    is_package = known[module].name == "__init__.py"
    return [*module.split("."), *(["__init__"] if is_package else [])]


def _fork(ours: Sequence[str], theirs: Sequence[str]) -> tuple[str, str, str]:
    """Return the folder that two files share, and in which of its entries each of them lies."""
    depth = next(i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b)
    return ".".join(ours[:depth]), ours[depth], theirs[depth]


def _complaints(module: str, entry: Import) -> Iterator[str]:
    if _top(entry.target) in HEAVY and not entry.lazy:
        yield f"imports {entry.target} at its top: import it inside the function that uses it"
    if _top(entry.target) != OURS:
        return
    package = next((package for package in PLUGINS if _within(module, (package,))), None)
    if package is not None:
        yield from _plugin_complaints(package, module, entry.target)
    elif _package(entry.target) not in _may_know(_package(module)):
        yield f"imports {entry.target}, which {_package(module) or 'the front door'} may not know"


def _may_know(package: str) -> frozenset[str]:
    """Add the package itself and the front door, whose top holds the version and nothing else."""
    return ALLOWED.get(package, frozenset()) | {package, ""}


def _plugin_complaints(package: str, module: str, target: str) -> Iterator[str]:
    """Judge an import of a plugin; what its package shares is in files that begin with ``_``."""
    kind, protocols = PLUGINS[package]
    plugin = ".".join(module.split(".")[: package.count(".") + 2])
    readers = READERS.get(plugin, ())
    if target == package or _within(target, (plugin, f"{OURS}.core", *protocols, *readers)):
        return
    if not _within(target, (package,)):
        library = " and its protocol library" if protocols else ""
        yield f"imports {target}: a {kind} knows core{library} only"
    elif not target.removeprefix(f"{package}.").startswith("_"):
        yield f"imports {target}: a plugin never imports another plugin"


def _pyarrow_in_record(
    graph: Mapping[str, Sequence[Import]], known: Mapping[str, Path], source: Path
) -> Iterator[Finding]:
    for module in sorted(_recording(graph)):
        for entry in graph[module]:
            if _top(entry.target) == "pyarrow":
                what = f"{module} imports pyarrow, and the record process imports {module}"
                yield Finding(_shown(known[module], source), entry.line, what)


def _recording(graph: Mapping[str, Sequence[Import]]) -> set[str]:
    """Return the modules of the record process and all that these import at their top."""
    reached: set[str] = set()
    waiting = [module for module in graph if _within(module, RECORDING)]
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += [e.target for e in graph[module] if e.target in graph and not e.lazy]
    return reached


def _top(module: str) -> str:
    return module.partition(".")[0]


def _package(module: str) -> str:
    return f"{module}.".split(".")[1]


def _within(module: str, packages: Sequence[str]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def _shown(path: Path, source: Path) -> str:
    return str(path.relative_to(source.parent))


class Import(NamedTuple):
    """One import of a module; ``lazy`` when it happens inside a function."""

    line: int
    target: str
    lazy: bool


def modules(source: Path) -> Mapping[str, Path]:
    """Return the modules below a source folder by their dotted name."""
    return {_dotted(path.relative_to(source)): path for path in sorted(source.rglob("*.py"))}


def imports(
    module: str, path: Path, known: Collection[str], *, typing: bool = False
) -> list[Import]:
    """Return what a module imports at run time; with ``typing`` also what type checkers import."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return [
        Import(node.lineno, target, lazy)
        for node, lazy in _statements(tree, lazy=False, typing=typing)
        for target in _targets(node, package, known)
    ]


def _dotted(relative: Path) -> str:
    parts = relative.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _statements(
    node: ast.AST, lazy: bool, typing: bool
) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, lazy
        elif isinstance(child, ast.If) and _is_type_checking(child.test) and not typing:
            for other in child.orelse:
                yield from _statements(ast.Module([other], []), lazy, typing)
        else:
            inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _statements(child, lazy or inside, typing)


def _is_type_checking(test: ast.expr) -> bool:
    name = test.attr if isinstance(test, ast.Attribute) else getattr(test, "id", "")
    return name == "TYPE_CHECKING"


def _targets(
    node: ast.Import | ast.ImportFrom, package: str, known: Collection[str]
) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    base = _base(node, package)
    names = {f"{base}.{alias.name}" for alias in node.names}
    submodules = names & set(known)
    yield from sorted(submodules)
    if names - submodules:
        yield base


def _base(node: ast.ImportFrom, package: str) -> str:
    if not node.level:
        return node.module or ""
    parts = package.split(".")
    parents = parts[: len(parts) - node.level + 1]
    return ".".join([*parents, *([node.module] if node.module else [])])


if __name__ == "__main__":
    sys.exit(report("import directions", check(ROOT / "src")))
