"""List sources, monitor modes, probes, kinds of actions and detectors, or explain one of them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from amberbox.blackbox.robot_folder.folder import SOURCES
from amberbox.cli._output import in_columns, print_lines
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.options import OptionRow, describe
from amberbox.core.plugins import Plugin, find, install_hint, missing_packages
from amberbox.detection.model_file import DETECTOR_DEFINES, DETECTORS
from amberbox.experiments.action import ACTIONS, DEFINES
from amberbox.monitoring.component_files import MODE_DEFINES, MODES, PROBE_DEFINES, PROBES


@dataclass(frozen=True)
class PluginKind:
    """One kind of plugin: its package, required definitions, and purpose."""

    package: str
    defines: tuple[str, ...]
    use: str

    def plugins(self) -> Mapping[str, Plugin]:
        """Return all plugins of this kind."""
        return find(self.package, defines=self.defines)


KINDS = {
    "source": PluginKind(SOURCES, ("Config", "Source"), "each a block of black_box.yaml"),
    "mode": PluginKind(MODES, MODE_DEFINES, "named by 'monitor:' in a mode file"),
    "probe": PluginKind(PROBES, PROBE_DEFINES, "what modes ask the robot's computer for"),
    "action": PluginKind(ACTIONS, DEFINES, "named by 'kind:' in actions/*.yaml"),
    "detector": PluginKind(DETECTORS, DETECTOR_DEFINES, "learnt by 'amberbox learn'"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this verb."""
    parser.add_argument(
        "name",
        nargs="?",
        help="a source, mode, probe, kind of action or detector: show a sample and its keys",
    )
    parser.add_argument("--kind", choices=KINDS, help="only plugins of this kind")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """List all plugins, or show one."""
    kinds = [args.kind] if args.kind else list(KINDS)
    return _show(args.name, kinds, args.json) if args.name else _list(kinds, args.json)


def _list(kinds: Sequence[str], as_json: bool) -> int:
    found = {kind: [_overview(kind, p) for p in KINDS[kind].plugins().values()] for kind in kinds}
    rows = [row for some in found.values() for row in some]
    if as_json:
        print(json.dumps(rows, indent=2))
        return 0
    for kind, some in found.items():
        print(f"{kind}s, {KINDS[kind].use}:")
        print_lines([*in_columns((row["name"], row["summary"]) for row in some), ""])
    for row in rows:
        if row["missing"]:
            print(f"'{row['name']}' lacks {', '.join(row['missing'])}. {row['install']}".rstrip())
    print("amberbox plugins NAME shows a sample and all keys")
    return 0


def _overview(kind: str, plugin: Plugin) -> dict[str, Any]:
    missing = missing_packages(plugin)
    hint = install_hint(plugin.name) if missing else ""
    return {
        "name": plugin.name,
        "kind": kind,
        "summary": plugin.summary,
        "missing": missing,
        "install": hint,
    }


def _show(name: str, kinds: Sequence[str], as_json: bool) -> int:
    kind, plugin = _one(name, kinds)
    details = _DETAILS[kind](plugin.load())
    if as_json:
        print(json.dumps(_overview(kind, plugin) | details, indent=2))
        return 0
    print_lines([f"{plugin.name}: {plugin.summary}"])
    print_lines(_SHOWN[kind](details))
    return 0


def _one(name: str, kinds: Sequence[str]) -> tuple[str, Plugin]:
    """Return the plugin with a name; raise UsageError if there is none, or if several have it."""
    known = {kind: KINDS[kind].plugins() for kind in kinds}
    found = [(kind, plugins[name]) for kind, plugins in known.items() if name in plugins]
    if len(found) > 1:
        what = f"'{name}' is a {' and a '.join(kind for kind, _ in found)}"
        raise UsageError(what, f"say which: --kind {found[0][0]}")
    if not found:
        names: Collection[str] = {name for plugins in known.values() for name in plugins}
        what = f"there is no {kinds[0] if len(kinds) == 1 else 'plugin'} '{name}'"
        raise UsageError(what + did_you_mean(name, names), "amberbox plugins lists all")
    return found[0]


def _source_details(module: Any) -> dict[str, Any]:
    sample = getattr(module, "SAMPLE", "")
    return {"sample": sample, "options": [asdict(row) for row in describe(module.Config)]}


def _mode_details(module: Any) -> dict[str, Any]:
    results = [asdict(result) for result in module.RESULTS]
    return {"inputs": list(module.ACCEPTS), "results": results, **_source_details(module)}


def _probe_details(module: Any) -> dict[str, Any]:
    measures = [
        {"name": name, "type": kind, "unit": unit, "doc": doc}
        for name, (kind, unit, doc) in module.MEASURES.items()
    ]
    return {"subject": module.SUBJECT, "measures": measures}


def _source_text(details: Mapping[str, Any]) -> Iterator[str]:
    if details["sample"]:
        yield from ("", details["sample"].rstrip())
    yield from ("", "keys:")
    yield from _option_table(details["options"])


def _mode_text(details: Mapping[str, Any]) -> Iterator[str]:
    yield from ("", details["sample"].rstrip(), "")
    yield f"inputs: {' or '.join(details['inputs'])}"
    yield from ("", "results:")
    yield from in_columns(_with_unit(row, row["name"]) for row in details["results"])
    yield from ("", "arguments:")
    yield from _option_table(details["options"]) if details["options"] else ["  none"]


def _probe_text(details: Mapping[str, Any]) -> Iterator[str]:
    yield f"subject: {details['subject']}"
    yield from ("", "measures:")
    rows = [("ok", "bool", "whether all is well; null if nobody can know")]
    yield from in_columns([*rows, *(_with_unit(r, r["name"]) for r in details["measures"])])


def _with_unit(row: Mapping[str, Any], name: str) -> tuple[str, str, str]:
    return name, row["type"], f"{row['doc']} [{row['unit']}]" if row["unit"] else row["doc"]


_DETAILS = {
    "source": _source_details,
    "mode": _mode_details,
    "probe": _probe_details,
    "action": _source_details,
    "detector": _source_details,
}
_SHOWN = {
    "source": _source_text,
    "mode": _mode_text,
    "probe": _probe_text,
    "action": _source_text,
    "detector": _source_text,
}


def _option_table(options: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    rows = [OptionRow(**row) for row in options]
    header = ("key", "value", "default", "meaning")
    table = [(row.key, row.type, _default(row), _meaning(row)) for row in rows]
    yield from in_columns([header, *table])


def _default(row: OptionRow) -> str:
    if row.default is None:
        return "required"
    return f"{row.default} {row.unit}".rstrip() if row.default else "-"


def _meaning(row: OptionRow) -> str:
    unit = f" [{row.unit}]" if row.unit else ""
    aliases = f" (also: {', '.join(row.aliases)})" if row.aliases else ""
    return f"{row.doc}{unit}{aliases}{'; secret' if row.secret else ''}"
