"""Read which module imports which, at its top or inside functions, without running any."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple


class Import(NamedTuple):
    """One import of a module; ``lazy`` when it happens inside a function."""

    line: int
    target: str
    lazy: bool


def modules(source: Path) -> Mapping[str, Path]:
    """Return the modules below a source folder by their dotted name."""
    return {_dotted(path.relative_to(source)): path for path in sorted(source.rglob("*.py"))}


def imports(module: str, path: Path, known: Collection[str]) -> list[Import]:
    """Return what a module imports at run time; imports for type checkers only do not count."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return [
        Import(node.lineno, target, lazy)
        for node, lazy in _statements(tree, lazy=False)
        for target in _targets(node, package, known)
    ]


def _dotted(relative: Path) -> str:
    parts = relative.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _statements(node: ast.AST, lazy: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, lazy
        elif isinstance(child, ast.If) and _is_type_checking(child.test):
            for other in child.orelse:
                yield from _statements(ast.Module([other], []), lazy)
        else:
            inside = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            yield from _statements(child, lazy or inside)


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
