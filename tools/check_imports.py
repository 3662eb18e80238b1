"""Check the import directions of docs/design.md 2: who may know of whom, and what loads late."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tools.findings import ROOT, Finding, report
from tools.import_graph import Import, imports, modules

OURS = "amberbox"
_UPPER = frozenset(
    {"core", "blackbox", "monitoring", "detection", "diagnosis", "consult", "experiments", "link"}
)
ALLOWED: Mapping[str, frozenset[str]] = {
    "core": frozenset(),
    "blackbox": frozenset({"core"}),
    "sim": frozenset({"core"}),
    "testing": frozenset({"core", "blackbox"}),
    "diagnosis": frozenset({"core"}),
    "monitoring": frozenset({"core", "blackbox"}),
    "detection": frozenset({"core", "blackbox"}),
    "consult": frozenset({"core", "blackbox", "monitoring", "diagnosis"}),
    "experiments": frozenset({"core", "blackbox"}),
    "link": frozenset({"core", "blackbox"}),
    "client": frozenset({"core", "blackbox"}),
    "robot": _UPPER,
    "fleet": _UPPER,
    "demo": _UPPER | {"sim", "robot", "fleet"},
    "cli": _UPPER | {"sim", "testing", "robot", "fleet", "client", "demo"},
    "": frozenset({"core", "blackbox", "client"}),
    "__main__": frozenset({"cli", "core"}),
}
"""Which of our packages each may import, besides itself; "" is the package's front door."""

SOURCES = f"{OURS}.blackbox.sources"
PROTOCOLS = (f"{OURS}.blackbox.ros1", f"{OURS}.blackbox.formats", f"{OURS}.sim")
"""Protocol libraries of our own: what a source may import besides ``core``."""

MODES = f"{OURS}.monitoring.modes"
PROBES = f"{OURS}.monitoring.probes"
ROS1 = f"{OURS}.blackbox.ros1"

PLUGINS: Mapping[str, tuple[str, Sequence[str]]] = {
    SOURCES: ("source", PROTOCOLS),
    MODES: ("mode", ()),
    PROBES: ("probe", (ROS1,)),
}
"""Packages of plugins: what one is called, and what it may import besides ``core``."""

READERS: Mapping[str, Sequence[str]] = {
    f"{SOURCES}.status": tuple(
        f"{OURS}.blackbox.{name}" for name in ("follow", "journal.reserved", "store", "where")
    ),
}
"""Plugins whose protocol is our own record: what a robot's watcher writes is read by its team."""

HEAVY = frozenset({"pyarrow", "duckdb", "zmq", "matplotlib", "pandas", "polars", "tsdownsample"})
RECORDING = tuple(
    f"{OURS}.{name}"
    for name in (
        "core",
        "sim",
        "blackbox.sources",
        "blackbox.filters",
        "blackbox.unroll",
        "blackbox.ros1",
        "blackbox.recorder",
        "blackbox.journal",
    )
)
"""The record process: where pyarrow must not be imported at all."""


def check(source: Path) -> list[Finding]:
    """Return every import below ``source`` that the directions forbid."""
    known = modules(source)
    graph = {module: imports(module, path, known) for module, path in known.items()}
    return [
        Finding(_shown(known[module], source), entry.line, f"{module} {what}")
        for module, entries in graph.items()
        for entry in entries
        for what in _complaints(module, entry)
    ] + list(_pyarrow_in_record(graph, known, source))


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
    plugin = ".".join(module.split(".")[:4])
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


if __name__ == "__main__":
    sys.exit(report("import directions", check(ROOT / "src")))
