"""Check that every command, source, filter and configuration key is documented, and every link."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import amberbox
from amberbox.cli.main import verbs
from amberbox.core.plugins import Plugin, find
from tools.findings import ROOT, Finding, report
from tools.markdown import anchors, links, pages

INTERNAL = ("docs/develop/", "CONTRIBUTING.md", "CHANGELOG.md")
"""Pages for those who build Amberbox: what is only mentioned there is not documented."""

MODES = ("amberbox.monitoring.modes", ("Config", "evaluate"))
PROBES = ("amberbox.monitoring.probes", ("MEASURES", "SUBJECT", "measure"))
ACTIONS = ("amberbox.experiments.actions", ("Config", "run"))
MODES_PAGE = "docs/robot/modes.md"


def check(root: Path) -> list[Finding]:
    """Return what the pages below ``root`` leave out, and their links that lead nowhere."""
    text = documentation(root)
    missing = [finding for finding, pattern in _to_document() if not re.search(pattern, text, re.M)]
    links_to_nothing = [finding for page in pages(root) for finding in broken_links(page, root)]
    return [*missing, *arguments_left_out(root), *links_to_nothing]


def arguments_left_out(root: Path) -> Iterator[Finding]:
    """Yield arguments of monitors that their own section of the page leaves out."""
    page = root / MODES_PAGE
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    found = re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    sections = dict(found)
    for name, plugin in find(MODES[0], defines=MODES[1]).items():
        for field in dataclasses.fields(plugin.load().Config):
            if not re.search(_as_code(field.name), sections.get(name, ""), re.MULTILINE):
                what = f"argument '{field.name}' of the monitor '{name}'"
                yield _undocumented(plugin, what)


def documentation(root: Path) -> str:
    """Join the pages that users read."""
    own = [page for page in pages(root) if not _shown(page, root).startswith(INTERNAL)]
    return "\n".join(page.read_text(encoding="utf-8") for page in own)


def broken_links(page: Path, root: Path) -> Iterator[Finding]:
    """Yield the links of a page that lead to no file or no heading of the project."""
    text = page.read_text(encoding="utf-8")
    for link in links(text):
        path, _, anchor = link.target.partition("#")
        if re.match(r"[a-z]+:", path):
            continue
        target = page.parent / path if path else page
        if not target.exists():
            yield Finding(_shown(page, root), link.line, f"the link to {path} leads nowhere")
        elif anchor and anchor not in anchors(target.read_text(encoding="utf-8")):
            yield Finding(_shown(page, root), link.line, f"{target.name} has no heading #{anchor}")


def _to_document() -> Iterator[tuple[Finding, str]]:
    """Yield each thing that needs a place in the documentation, and how it looks there."""
    for name, verb in verbs().items():
        yield _undocumented(verb, f"command 'amberbox {name}'"), rf"\bamberbox {re.escape(name)}\b"
    for name, plugin in find("amberbox.blackbox.sources", defines=("Config", "Source")).items():
        yield _undocumented(plugin, f"source '{name}'"), _as_code(name)
    for kind, (package, names) in {"monitor": MODES, "probe": PROBES, "action": ACTIONS}.items():
        for name, plugin in find(package, defines=names).items():
            yield _undocumented(plugin, f"{kind} '{name}'"), rf"{_as_code(name)}|^## {name}$"
    for module, name, key in configuration_keys():
        path = Path(inspect.getsourcefile(module) or "")
        finding = Finding(_shown(path, ROOT), 0, f"key '{key}' of {name} is not documented")
        yield finding, _as_code(key)


def configuration_keys() -> Iterator[tuple[ModuleType, str, str]]:
    """Yield every key that is declared with ``option()``: its module, class and name."""
    for module in _modules():
        for name, cls in inspect.getmembers(module, inspect.isclass):
            if cls.__module__ == module.__name__ and dataclasses.is_dataclass(cls):
                own = [field for field in dataclasses.fields(cls) if "doc" in field.metadata]
                yield from ((module, name, field.name) for field in own)


def _modules() -> Iterator[ModuleType]:
    for info in pkgutil.walk_packages(amberbox.__path__, "amberbox."):
        if not info.name.endswith("__main__"):
            yield importlib.import_module(info.name)


def _as_code(word: str) -> str:
    """Match a word between backticks, or as a key or item of YAML."""
    plain = re.escape(word)
    return rf"`[^`\n]*(?<!\w){plain}(?!\w)[^`\n]*`|^[ \-{{]*{plain}:|[{{,] *{plain}:"


def _undocumented(plugin: Plugin, what: str) -> Finding:
    path = _shown(plugin.path, ROOT) if plugin.path else plugin.target
    return Finding(path, 0, f"{what} is not documented")


def _shown(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else str(path)


if __name__ == "__main__":
    sys.exit(report("documentation", check(ROOT)))
