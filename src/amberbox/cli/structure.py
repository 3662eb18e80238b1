"""Structural analysis of a model of equations: what can be detected and isolated, and by what."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from amberbox.cli import _residuals
from amberbox.cli._arguments import add_seconds, budget_of, refuse_options, robot_at
from amberbox.cli._models import add_model, model_path
from amberbox.cli._output import print_grid, print_json, print_lines, print_notes
from amberbox.client.address import is_url
from amberbox.core.equations.model_file import load_equations
from amberbox.core.equations.structure import Causality
from amberbox.core.errors import UsageError
from amberbox.diagnosis.structure.answers import SetKind, faults_json, sets_json

_MOST_SETS = 100_000
_SECONDS = 60.0
_SHOWN = 20


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_model(parser, "MODEL.yaml")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--mso", action="store_true", help="minimal over-determined sets: each is a possible test"
    )
    what.add_argument("--mtes", action="store_true", help="sets that show as few faults as can be")
    what.add_argument(
        "--isolability", choices=[causality.value for causality in Causality], metavar="CAUSALITY",
        help="which faults can be told apart if derivatives may be computed both ways (mixed), "
        "only be integrated (int), or only be differentiated (der)",
    )  # fmt: skip
    what.add_argument(
        "--sensors", action="store_true",
        help="minimal sets of further sensors with which most can be told apart",
    )  # fmt: skip
    _residuals.add_options(parser, what)
    parser.add_argument(
        "--measurable", nargs="+", default=[], metavar="UNKNOWN", help="with --sensors: only these"
    )
    parser.add_argument(
        "--fallible", action="store_true", help="with --sensors: the new ones may fail, too"
    )
    add_seconds(parser, _SECONDS)
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Analyse and show; return 1 when time ended before all was found."""
    if (args.measurable or args.fallible) and not args.sensors:
        raise UsageError("--measurable and --fallible belong to --sensors")
    _residuals.check_options(args)
    if args.residuals:
        return _residuals.run(model_path(args.where, "equations", args.name), args)
    kind: SetKind | None = (
        "mso" if args.mso else "mtes" if args.mtes else "sensor_sets" if args.sensors else None
    )
    found = _asked(args, kind) if is_url(args.where) else _computed(args, kind)
    if args.json:
        print_json(found)
    elif kind is None:
        _show_faults(found)
    else:
        print_lines(_as_text(found[kind]))
    if found["incomplete"]:
        print_notes([f"incomplete: {found['incomplete']}"])
    return 1 if found["incomplete"] else 0


def _computed(args: argparse.Namespace, kind: SetKind | None) -> Mapping[str, Any]:
    budget = budget_of(args)
    path = model_path(args.where, "equations", args.name)
    model = load_equations(path)
    if kind is None:
        found = faults_json(model, Causality(args.isolability or "mixed"), budget)
    else:
        asked = args.measurable
        found = sets_json(model, kind, budget, _MOST_SETS, asked, fallible=args.fallible)
    more = "; --seconds allows more" if found["incomplete"].startswith("time was up") else ""
    return {"model": str(path), **found, "incomplete": found["incomplete"] + more}


def _asked(args: argparse.Namespace, kind: SetKind | None) -> Mapping[str, Any]:
    """Ask a server."""
    refuse_options(args.where, {"seconds": args.seconds != _SECONDS}, "it has a limit of its own")
    fleet, robot = robot_at(args.where)
    with fleet:
        return fleet.structure(
            robot, args.name, show=kind or "faults", causality=args.isolability or "mixed",
            measurable=args.measurable, fallible=args.fallible,
        )  # fmt: skip


def _as_text(found: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"{len(found):,} sets" if len(found) != 1 else "1 set"
    for names in found[:_SHOWN]:
        yield f"  {', '.join(names) or 'none: nothing needs to be added'}"
    if len(found) > _SHOWN:
        yield f"  and {len(found) - _SHOWN:,} more (--json shows all)"


def _show_faults(found: Mapping[str, Any]) -> None:
    rows = []
    for fault, mistaken in found["not_told_from"].items():
        seen = fault in found["detectable"]
        others = [other for other in mistaken if other != fault]
        told = ", ".join(others) or "none" if seen else "cannot be detected"
        rows.append((fault, "yes" if seen else "no", told))
    print_grid(("fault", "detectable", "may be taken for"), rows)
