"""The fault trees of a robot's failure modes: what can make it lose each of its functions."""

from __future__ import annotations

import argparse

from amberbox.cli._faulttree_answer import limit_note, show
from amberbox.cli._output import print_grid, print_json, tell
from amberbox.cli.fmea import fmea_path, loaded
from amberbox.consult.faulttrees import description, effects_json
from amberbox.core.config import refuse
from amberbox.diagnosis.faulttree import Analysis, Budget, analyse
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.trees import effects, fault_tree_of


def fmea_of(where: str) -> Fmea:
    """Read the failure modes of a robot folder or a file; raise if anything is wrong."""
    fmea, _, problems = loaded(fmea_path(where))
    refuse(problems)
    assert fmea is not None, "a file without errors has been read"
    return fmea


def analysed(fmea: Fmea, effect: str, args: argparse.Namespace, budget: Budget) -> Analysis:
    """Solve the tree of one effect."""
    tree = fault_tree_of(fmea, effect, args.exposure)
    return analyse(tree, args.order, args.importance, budget)


def show_all(fmea: Fmea, args: argparse.Namespace, budget: Budget) -> bool:
    """Show all effects on the system; tell whether all was done."""
    found = [analysed(fmea, effect, args, budget) for effect in effects(fmea)]
    if not found:
        tell([f"{args.where} has no functions that could be lost; --effect takes components, too"])
    if args.json:
        asked = args.exposure, args.importance, args.cut_sets or 0
        print_json({"file": args.where, **effects_json(fmea, found, *asked)})
    elif args.importance or args.cut_sets:
        for place, analysis in enumerate(found):
            print("\n" * (place > 0), end="")
            show(analysis, args)
    else:
        _table(fmea, found, args)
    return not any(analysis.incomplete for analysis in found)


def _table(fmea: Fmea, found: list[Analysis], args: argparse.Namespace) -> None:
    header = ("effect", "probability", "cut sets", "of order", "smallest", "what is lost")
    print_grid(header, [_row(fmea, analysis) for analysis in found])
    if args.order is not None:
        print(f"cut sets{limit_note(args.order)}")


def _row(fmea: Fmea, analysis: Analysis) -> list[str]:
    chance, what = analysis.top_probability, description(fmea, analysis)["description"]
    first = [analysis.tree.top, "-" if chance is None else f"{chance:.3g}"]
    if analysis.by_order is None:
        return [*first, "-", "-", "-", what]
    counts = {order: count for order, count in enumerate(analysis.by_order) if count}
    by_order = ", ".join(f"{order}: {count:,}" for order, count in counts.items())
    smallest = str(min(counts)) if counts else "-"
    return [*first, f"{analysis.minimal_cut_sets:,}", by_order or "-", smallest, what]
