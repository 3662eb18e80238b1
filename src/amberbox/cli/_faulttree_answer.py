"""What is known of one fault tree, as text."""

from __future__ import annotations

import argparse

from amberbox.cli._output import print_grid
from amberbox.cli._text import print_lines
from amberbox.consult.faulttrees import FACTORS, listed
from amberbox.diagnosis.faulttree import Analysis, FaultTree
from amberbox.diagnosis.faulttree.likelihood import Importance


def show(analysis: Analysis, args: argparse.Namespace) -> None:
    """Print it for people."""
    tree = analysis.tree
    size = f"{len(analysis.gates)} gates, {len(analysis.events)} basic events"
    print_lines([f"{called(tree, tree.top)}: {size}"])
    if not analysis.coherent:
        print("not coherent: cut sets are the positive parts of the minimal solutions")
    _show_probability(analysis)
    _show_cut_sets(analysis, args.cut_sets or 0)
    if analysis.importance:
        print()
        rows = [_row(tree, event, entry) for event, entry in analysis.importance.items()]
        print_grid(("event", *(name.upper() for name in FACTORS)), rows)


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
    print(f"minimal cut sets: {analysis.minimal_cut_sets:,}{limit_note(analysis.truncated_at)}")
    for order, number in enumerate(analysis.by_order):
        if number:
            print(f"  order {order}: {number:,}")
    for entry in listed(analysis, count):
        print_lines(["  {" + ", ".join(called(analysis.tree, e) for e in sorted(entry)) + "}"])


def limit_note(limit: int | None) -> str:
    """Say that larger cut sets are left out, where they are."""
    return "" if limit is None else f", up to order {limit}: larger ones are not counted"


def called(tree: FaultTree, name: str) -> str:
    """Return the name of a gate or event, with its label where it has one."""
    named = tree.gates.get(name) or tree.events.get(name)
    return f"{name} ({named.label})" if named is not None and named.label else name


def _row(tree: FaultTree, event: str, entry: Importance) -> tuple[str, ...]:
    values = (getattr(entry, name) for name in FACTORS)
    return (called(tree, event), *(f"{value:.6g}" for value in values))
