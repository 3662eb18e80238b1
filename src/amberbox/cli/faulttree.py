"""Solve fault trees, compiled or of a file: minimal cut sets, exact probability, what matters."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from amberbox.cli._anyorder import accept_any_order
from amberbox.cli._faulttree_answer import show
from amberbox.cli._output import accept_relative_times, print_json, tell, text_output
from amberbox.cli._server import add_where
from amberbox.client.address import is_url
from amberbox.consult.faulttrees import analysis_json
from amberbox.core.errors import UsageError
from amberbox.diagnosis.faulttree import Analysis, Budget, FaultTree, analyse, read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import DEFAULT_MISSION_TIME_H

_SECONDS = 300.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    accept_any_order(parser)
    what = "robot folder or fmea.yaml, or a fault tree in Open-PSA MEF"
    add_where(parser, what, "WHERE|FILE.xml")
    parser.add_argument(
        "more", nargs="*", metavar="FILE.xml", help="further files of the same model"
    )
    parser.add_argument(
        "--effect", default="", metavar="NAME",
        help="the function or component that is lost; the top gate of a file with several",
    )  # fmt: skip
    parser.add_argument("--order", type=int, metavar="N", help="only cut sets of up to N events")
    parser.add_argument("--importance", action="store_true", help="what matters most, by event")
    parser.add_argument("--cut-sets", type=int, metavar="N", help="list the N smallest cut sets")
    parser.add_argument("--export", metavar="FILE", help="write the tree as Open-PSA MEF")
    parser.add_argument(
        "--exposure", type=float, metavar="H",
        help="hours since all was known to be well, instead of the FMEA's",
    )  # fmt: skip
    parser.add_argument(
        "--closest", action="store_true",
        help="which cut sets the robot's diagnosis brings closest to complete",
    )  # fmt: skip
    parser.add_argument("--at", metavar="T", help="with --closest: as it was then")
    _configure_solving(parser)
    parser.add_argument("--json", action="store_true", help="one object")


def _configure_solving(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--mission-time", type=float, default=DEFAULT_MISSION_TIME_H, metavar="H",
        help="hours, for expressions of a file that use it (default: a year)",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=float, default=_SECONDS, metavar="S",
        help=f"give up after S seconds (default {_SECONDS:g})",
    )  # fmt: skip
    parser.add_argument(
        "--nodes", type=int, default=Budget().nodes, metavar="N",
        help="give up at N nodes, about 200 bytes each (default %(default)s)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Solve and show; 1 when a budget ended before all was done."""
    _check(args)
    if is_url(args.where):
        from amberbox.cli._remote_knowledge import faulttree_remote

        return faulttree_remote(args)
    ends = time.monotonic() + args.seconds
    budget = Budget(args.nodes, lambda: time.monotonic() > ends)
    if _is_tree(args.where):
        files = [args.where, *args.more]
        return _one(read_mef(files, args.effect, args.mission_time), args, budget)
    return _compiled(args, budget)


def _is_tree(where: str) -> bool:
    return Path(where).suffix.lower() == ".xml"


def _compiled(args: argparse.Namespace, budget: Budget) -> int:
    """Compile the trees of failure modes: one, all, or what is closest to happening."""
    from amberbox.cli._faulttree_closest import show_closest
    from amberbox.cli._faulttree_effects import fmea_of, show_all
    from amberbox.diagnosis.fmea.trees import fault_tree_of

    fmea = fmea_of(args.where)
    if args.closest:
        show_closest(fmea, args, budget)
        return 0
    if args.effect:
        return _one(fault_tree_of(fmea, args.effect, args.exposure), args, budget)
    if show_all(fmea, args, budget):
        return 0
    tell(["incomplete: --seconds and --nodes allow more"])
    return 1


def _one(tree: FaultTree, args: argparse.Namespace, budget: Budget) -> int:
    """Solve one tree and show it."""
    if args.export:
        with text_output(args.export) as file:
            file.write(write_mef(tree))
    analysis = analyse(tree, args.order, args.importance, budget)
    if args.json:
        made = analysis_json(analysis, args.importance, args.cut_sets or 0)
        files = {"files": [args.where, *args.more]} if args.more else {}
        print_json({"file": args.where, **files, **made})
    else:
        show(analysis, args)
    return _finished(analysis)


def _finished(analysis: Analysis) -> int:
    if not analysis.incomplete:
        return 0
    tell([f"incomplete: {analysis.incomplete}; --seconds and --nodes allow more"])
    return 1


def _check(args: argparse.Namespace) -> None:
    for name, least in (("order", 0), ("cut_sets", 1), ("nodes", 1)):
        given = getattr(args, name)
        if given is not None and given < least:
            raise UsageError(f"--{name.replace('_', '-')} must be {least} or more")
    for name in ("seconds", "mission_time", "exposure"):
        given = getattr(args, name)
        if given is not None and not 0.0 <= given < math.inf:
            raise UsageError(f"--{name.replace('_', '-')} must be a number, 0 or more")
    if args.more and not all(map(_is_tree, (args.where, *args.more))):
        raise UsageError("several can be given of FILE.xml only", "amberbox faulttree A.xml B.xml")
    if _is_tree(args.where):
        _check_file(args)
    else:
        _check_compiled(args)


def _check_file(args: argparse.Namespace) -> None:
    if args.exposure is not None:
        what = "--exposure is for failure modes; a file has its own probabilities"
        raise UsageError(what, "--mission-time is what expressions of a file are computed with")
    if args.closest or args.at:
        raise UsageError(
            "only of a robot folder is known what is close", "amberbox faulttree WHERE"
        )


def _check_compiled(args: argparse.Namespace) -> None:
    if args.export and (args.closest or not args.effect):
        raise UsageError("one tree can be exported at a time", "name it: --effect NAME")
    if args.at and not args.closest:
        raise UsageError("--at is for --closest", "amberbox faulttree WHERE --closest --at T")
    if args.mission_time != DEFAULT_MISSION_TIME_H:
        raise UsageError("--mission-time is for expressions of a file", "--exposure H")
    if args.closest and args.importance:
        raise UsageError("--closest shows no importance", "leave out one of them")
