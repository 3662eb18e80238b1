"""List the sources that the box can listen to, or explain one of them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from amberbox.blackbox.folder.folder import SOURCES
from amberbox.cli._text import in_columns
from amberbox.core.describe import OptionRow, describe
from amberbox.core.plugins import Plugin, find, get, install_hint, missing_packages


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument("name", nargs="?", help="a source: show a sample and all its keys")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List all sources, or show one."""
    return _show(args.name, args.json) if args.name else _list(args.json)


def _list(as_json: bool) -> int:
    found = [_overview(plugin) for plugin in find(SOURCES, defines=("Config", "Source")).values()]
    if as_json:
        print(json.dumps(found, indent=2))
        return 0
    print("sources, each a block of black_box.yaml:")
    print("\n".join(in_columns((row["name"], row["summary"]) for row in found)))
    for row in found:
        if row["missing"]:
            print(f"'{row['name']}' lacks {', '.join(row['missing'])}. {row['install']}".rstrip())
    print("amberbox plugins NAME shows a sample and all keys")
    return 0


def _overview(plugin: Plugin) -> dict[str, Any]:
    missing = missing_packages(plugin)
    hint = install_hint(plugin.name) if missing else ""
    return {
        "name": plugin.name,
        "summary": plugin.summary,
        "missing": missing,
        "install": hint,
    }


def _show(name: str, as_json: bool) -> int:
    plugin = get(SOURCES, name, defines=("Config", "Source"))
    module = plugin.load()
    options = list(describe(module.Config))
    if as_json:
        rows = [asdict(row) for row in options]
        print(json.dumps(_overview(plugin) | {"sample": module.SAMPLE, "options": rows}, indent=2))
        return 0
    print(f"{plugin.name}: {plugin.summary}\n\n{module.SAMPLE.rstrip()}\n\nkeys:")
    print("\n".join(in_columns(_option_rows(options))))
    return 0


def _option_rows(options: Sequence[OptionRow]) -> list[tuple[str, str, str, str]]:
    header = ("key", "value", "default", "meaning")
    return [header, *((row.key, row.type, _default(row), _meaning(row)) for row in options)]


def _default(row: OptionRow) -> str:
    if row.default is None:
        return "required"
    return f"{row.default} {row.unit}".rstrip() if row.default else "-"


def _meaning(row: OptionRow) -> str:
    unit = f" [{row.unit}]" if row.unit else ""
    aliases = f" (also: {', '.join(row.aliases)})" if row.aliases else ""
    return f"{row.doc}{unit}{aliases}{'; secret' if row.secret else ''}"
