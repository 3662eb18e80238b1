"""Solve a fault tree: minimal cut sets, exact probability, what matters most."""

from __future__ import annotations

import argparse
import math
import time
from itertools import islice
from pathlib import Path
from typing import Any

from amberbox.cli._output import print_grid, print_json, tell, text_output
from amberbox.core.errors import UsageError
from amberbox.diagnosis.faulttree import Analysis, Budget, FaultTree, analyse, read_mef, write_mef
from amberbox.diagnosis.faulttree.likelihood import Importance
from amberbox.diagnosis.faulttree.tree import DEFAULT_MISSION_TIME_H

_FACTORS = ("mif", "cif", "dif", "raw", "rrw")
_SECONDS = 300.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("file", metavar="FILE.xml", help="a fault tree in Open-PSA MEF")
    parser.add_argument("--effect", default="", metavar="NAME", help="the top gate, if several")
    parser.add_argument("--order", type=int, metavar="N", help="only cut sets of up to N events")
    parser.add_argument("--importance", action="store_true", help="what matters most, by event")
    parser.add_argument("--cut-sets", type=int, metavar="N", help="list the N smallest cut sets")
    parser.add_argument("--export", metavar="FILE", help="write the tree as Open-PSA MEF")
    parser.add_argument(
        "--mission-time", type=float, default=DEFAULT_MISSION_TIME_H, metavar="H",
        help="hours, for expressions that use it (default: a year)",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=float, default=_SECONDS, metavar="S",
        help=f"give up after S seconds (default {_SECONDS:g})",
    )  # fmt: skip
    parser.add_argument(
        "--nodes", type=int, default=Budget().nodes, metavar="N",
        help="give up at N nodes, about 200 bytes each (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Solve and show; 1 when a budget ended before all was done."""
    _check(args)
    tree = read_mef(args.file, args.effect, args.mission_time)
    if args.export:
        with text_output(args.export) as file:
            file.write(write_mef(tree))
    ends = time.monotonic() + args.seconds
    budget = Budget(args.nodes, lambda: time.monotonic() > ends)
    analysis = analyse(tree, args.order, args.importance, budget)
    if args.json:
        print_json(_as_json(analysis, args))
    else:
        _show(analysis, args)
    if analysis.incomplete:
        tell([f"incomplete: {analysis.incomplete}; --seconds and --nodes allow more"])
    return 1 if analysis.incomplete else 0


def _check(args: argparse.Namespace) -> None:
    if Path(args.file).suffix.lower() != ".xml":
        raise UsageError(f"{args.file} is no .xml file", "give a fault tree in Open-PSA MEF")
    for name, least in (("order", 0), ("cut_sets", 1), ("nodes", 1)):
        given = getattr(args, name)
        if given is not None and given < least:
            raise UsageError(f"--{name.replace('_', '-')} must be {least} or more")
    for name in ("seconds", "mission_time"):
        if not 0.0 <= getattr(args, name) < math.inf:
            raise UsageError(f"--{name.replace('_', '-')} must be a number, 0 or more")


def _as_json(analysis: Analysis, args: argparse.Namespace) -> dict[str, Any]:
    by_order = analysis.by_order
    answer: dict[str, Any] = {
        "file": args.file,
        "top": analysis.tree.top,
        "gates": len(analysis.gates),
        "basic_events": len(analysis.events),
        "coherent": analysis.coherent,
        "minimal_cut_sets": analysis.minimal_cut_sets,
        "by_order": None if by_order is None else list(by_order),
        "truncated_at": analysis.truncated_at,
        "top_probability": analysis.top_probability,
        "rare_event_sum": analysis.rare_event_sum(),
        "min_cut_upper_bound": analysis.upper_bound(),
        "without_probability": list(analysis.without_probability),
        "importance": None,
        "incomplete": bool(analysis.incomplete),
        "incomplete_because": analysis.incomplete,
    }
    if args.importance and analysis.top_probability is not None:
        answer["importance"] = {
            event: {name: _finite(getattr(entry, name)) for name in _FACTORS}
            for event, entry in analysis.importance.items()
        }
    if args.cut_sets:
        answer["cut_sets"] = [sorted(entry) for entry in _listed(analysis, args.cut_sets)]
    return answer


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _listed(analysis: Analysis, count: int) -> list[frozenset[str]]:
    return list(islice(analysis.cut_sets or (), count))


def _show(analysis: Analysis, args: argparse.Namespace) -> None:
    tree = analysis.tree
    size = f"{len(analysis.gates)} gates, {len(analysis.events)} basic events"
    print(f"{_called(tree, tree.top)}: {size}")
    if not analysis.coherent:
        print("not coherent: cut sets are the positive parts of the minimal solutions")
    _show_probability(analysis)
    _show_cut_sets(analysis, args.cut_sets or 0)
    if analysis.importance:
        print()
        rows = [_row(tree, event, entry) for event, entry in analysis.importance.items()]
        print_grid(("event", *(name.upper() for name in _FACTORS)), rows)


def _show_probability(analysis: Analysis) -> None:
    missing = analysis.without_probability
    if missing:
        print(f"probability: none; without one: {', '.join(missing[:5])}, {len(missing)} in all")
    elif analysis.top_probability is not None:
        print(f"probability: {analysis.top_probability:.10g} (exact)")
        upper, total = analysis.upper_bound(), analysis.rare_event_sum()
        kind = "an upper bound" if analysis.truncated_at is None else "of these cut sets only"
        if upper is not None:
            print(f"  min cut upper bound: {upper:.10g} ({kind})")
        if total is not None:
            print(f"  rare-event sum: {total:.10g} ({kind})")


def _show_cut_sets(analysis: Analysis, count: int) -> None:
    if analysis.by_order is None:
        return
    limit = analysis.truncated_at
    cut = "" if limit is None else f", up to order {limit}: larger ones are not counted"
    print(f"minimal cut sets: {analysis.minimal_cut_sets:,}{cut}")
    for order, number in enumerate(analysis.by_order):
        if number:
            print(f"  order {order}: {number:,}")
    for entry in _listed(analysis, count):
        print("  {" + ", ".join(_called(analysis.tree, event) for event in sorted(entry)) + "}")


def _called(tree: FaultTree, name: str) -> str:
    named = tree.gates.get(name) or tree.events.get(name)
    return f"{name} ({named.label})" if named is not None and named.label else name


def _row(tree: FaultTree, event: str, entry: Importance) -> tuple[str, ...]:
    values = (getattr(entry, name) for name in _FACTORS)
    return (_called(tree, event), *(f"{value:.6g}" for value in values))
