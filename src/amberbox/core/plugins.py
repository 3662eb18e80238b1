"""Discovery of plugins by file name: they are imported only when they are used."""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import sys
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points, metadata
from pathlib import Path
from types import ModuleType

from amberbox.core.errors import AmberboxError, UsageError, did_you_mean


@dataclass(frozen=True, slots=True)
class Plugin:
    """A plugin that was found and is not imported yet.

    ``target`` is a module's dotted name, or empty for a loose file.
    """

    name: str
    summary: str
    target: str
    path: Path | None = None

    def load(self) -> ModuleType:
        """Import the plugin; raise AmberboxError if it, or a library it needs, is missing."""
        try:
            return importlib.import_module(self.target) if self.target else self._load_file()
        except ImportError as error:
            what = f"plugin '{self.name}' cannot be loaded: {error}"
            raise AmberboxError(what, install_hint(self.name)) from error

    def _load_file(self) -> ModuleType:
        digits = hashlib.sha256(str(self.path).encode()).hexdigest()[:8]
        name = f"amberbox_plugin_{digits}_{self.name}"
        spec = importlib.util.spec_from_file_location(name, self.path or "")
        if spec is None or spec.loader is None:
            raise ImportError(f"{self.path} is no Python file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module


def find(
    package: str, extra_dirs: Sequence[Path] = (), defines: Collection[str] = ()
) -> Mapping[str, Plugin]:
    """Find the plugins of a package such as ``amberbox.blackbox.sources`` by file name, sorted.

    Files in ``extra_dirs`` and entry points of the group ``amberbox.<last word of the package>``
    are added; a name that is taken stays with the first. With ``defines``, only modules that
    define all these names at their top level count. A trailing ``_`` is not part of the name, so
    that ``import_.py`` can be the plugin ``import``.
    """
    found: dict[str, Plugin] = {}
    for plugin in _candidates(package, extra_dirs, defines):
        found.setdefault(plugin.name, plugin)
    return dict(sorted(found.items()))


def get(
    package: str, name: str, extra_dirs: Sequence[Path] = (), defines: Collection[str] = ()
) -> Plugin:
    """Return one plugin; raise UsageError with the most similar name if there is none."""
    known = find(package, extra_dirs, defines)
    if name not in known:
        kind = package.rpartition(".")[2].removesuffix("s")
        what = f"there is no {kind} '{name}'{did_you_mean(name, known)}"
        raise UsageError(what, f"known: {', '.join(known)}")
    return known[name]


def missing_packages(plugin: Plugin) -> list[str]:
    """Return the packages that a plugin's file imports anywhere and that are not installed."""
    if plugin.path is None:
        return []
    tree = _parsed(plugin.path.read_text(encoding="utf-8", errors="replace"))
    nodes = ast.walk(tree) if tree else ()
    imported = {name.partition(".")[0] for node in nodes for name in _imported(node)}
    return sorted(name for name in imported if importlib.util.find_spec(name) is None)


def install_hint(name: str) -> str:
    """Return how to install the packages that a plugin needs, if there is an extra of its name."""
    extras = metadata("amberbox").get_all("Provides-Extra") or ()
    return f"pip install 'amberbox[{name}]'" if name in extras else ""


def _candidates(
    package: str, extra_dirs: Sequence[Path], defines: Collection[str]
) -> Iterator[Plugin]:
    for folder in _folders(package):
        yield from _in_folder(folder, package, defines)
    for folder in extra_dirs:
        yield from _in_folder(folder, "", defines)
    yield from entry_points_of(f"amberbox.{package.rpartition('.')[2]}")


def _folders(package: str) -> list[Path]:
    try:
        spec = importlib.util.find_spec(package)
    except ModuleNotFoundError:
        return []
    return [Path(place) for place in (spec and spec.submodule_search_locations) or ()]


def _in_folder(folder: Path, package: str, defines: Collection[str]) -> Iterator[Plugin]:
    for path in sorted([*folder.glob("*.py"), *folder.glob("*/__init__.py")]):
        stem = path.parent.name if path.name == "__init__.py" else path.stem
        if path.parent == folder and path.name == "__init__.py":
            continue
        if stem.startswith("_"):
            continue
        tree = _parsed(path.read_text(encoding="utf-8", errors="replace"))
        if _defines(tree, defines):
            target = f"{package}.{stem}" if package else ""
            yield Plugin(stem.rstrip("_"), _summary(tree), target, path)


# Python 3.11 counts the depth of a syntax tree once for all threads, and raises
_PARSING = threading.Lock()


def _parsed(text: str) -> ast.Module | None:
    """Read a module without running it; None if it has an error."""
    try:
        with _PARSING:
            return ast.parse(text)
    except (SyntaxError, ValueError):
        return None


def _summary(tree: ast.Module | None) -> str:
    docstring = ast.get_docstring(tree) if tree else None
    return docstring.splitlines()[0] if docstring else ""


def _defines(tree: ast.Module | None, names: Collection[str]) -> bool:
    """Return whether a module defines the names; a module with an error counts, to be reported."""
    if tree is None or not names:
        return True
    return set(names) <= {name for statement in tree.body for name in _names(statement)}


def _names(statement: ast.stmt) -> Iterator[str]:
    if isinstance(statement, ast.ClassDef | ast.FunctionDef):
        yield statement.name
    elif isinstance(statement, ast.ImportFrom | ast.Import):
        yield from (alias.asname or alias.name for alias in statement.names)
    elif isinstance(statement, ast.Assign):
        yield from (target.id for target in statement.targets if isinstance(target, ast.Name))


def _imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module


def entry_points_of(group: str) -> Iterator[Plugin]:
    """Yield the plugins that installed packages declare in a group of entry points."""
    for point in entry_points(group=group):
        owner = point.dist.name if point.dist else "another package"
        yield Plugin(point.name, f"From the package {owner}.", point.value)
