"""Import paths in the documentation keep working, whatever is moved."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tools.findings import ROOT

LISTED = Path(__file__).parent / "documented_imports.txt"
DOTTED = re.compile(r"\bamberbox(?:\.[a-z_]\w*)+(?:\.[A-Z]\w*)?")
STATEMENT = re.compile(r"from (amberbox[\w.]*) import (\([^)]*\)|[^\n]*)")
NO_MODULE = {
    "amberbox.service", "amberbox.org", "amberbox.table", "amberbox.yaml", "amberbox.broken",
    "amberbox.actions", "amberbox.sources",
}  # fmt: skip
"""Words of the documentation that look like a module: a unit, metadata of a file, a folder, a
group of entry points."""


def listed() -> list[tuple[str, list[str]]]:
    """Return the listed modules with their names."""
    lines = (line.partition("#")[0].strip() for line in LISTED.read_text().splitlines())
    found = []
    for line in filter(None, lines):
        module, _, names = line.partition(":")
        found.append((module.strip(), [one.strip() for one in names.split(",") if one.strip()]))
    return found


def resolved(dotted: str) -> Any:
    """Return a module, or an attribute of one: the longest importable beginning counts."""
    try:
        return import_module(dotted)
    except ModuleNotFoundError as error:
        outer, _, name = dotted.rpartition(".")
        if not dotted.startswith(f"{error.name}") or not outer:
            raise
        return getattr(resolved(outer), name)


def documented() -> Iterator[tuple[str, str]]:
    """Yield each module and name that the documentation imports, and each dotted path in it."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*")]
    for page in pages:
        if page.suffix not in (".md", ".py", ".yaml", ".txt"):
            continue
        text = page.read_text()
        for module, names in STATEMENT.findall(text):
            yield from ((module, name.split()[0]) for name in names.strip("()").split(",") if name)
        for dotted in DOTTED.findall(STATEMENT.sub("", text)):
            if not any(dotted.startswith(word) for word in NO_MODULE):
                module, _, name = dotted.rpartition(".")
                yield (module, name)


@pytest.mark.parametrize(("module", "names"), listed(), ids=lambda one: str(one)[:60])
def test_it_is_there(module: str, names: list[str]) -> None:
    resolved(module)
    for name in names:
        resolved(f"{module}.{name}")


def test_nothing_is_documented_that_is_not_listed() -> None:
    """A page that names something new lists it here, and from then on it stays."""
    known = {(module, name) for module, names in listed() for name in names}
    known |= {(*module.rpartition(".")[::2],) for module, _ in listed()}
    known |= {(f"{m}.{n}".rpartition(".")[0], n) for m, names in listed() for n in names}
    missing = sorted({one for one in documented() if one not in known})
    assert missing == []


def test_a_module_has_no_place_in_the_list_twice() -> None:
    plain = [module for module, _ in listed() if isinstance(resolved(module), ModuleType)]
    assert sorted(plain) == sorted(set(plain))
