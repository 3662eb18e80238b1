"""Fault trees of a robot, its server or a file: cut sets, exact probability, importance."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amberbox.cli._arguments import (
    accept_any_order,
    accept_relative_times,
    add_seconds,
    add_where,
    budget_of,
    check_time,
    opened,
    refuse_options,
    robot_at,
    time_of,
)
from amberbox.cli._output import print_grid, print_json, print_lines, print_notes, text_output
from amberbox.cli.fmea import FOR_LOCAL_FOLDER, fmea_path, loaded
from amberbox.client.address import is_url
from amberbox.core.config import raise_errors
from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.core.names import component_id
from amberbox.core.timestamps import format_time
from amberbox.diagnosis.faulttree.analysis import (
    Analysis,
    Importance,
    NearCutSet,
    analyse,
    most_probable,
)
from amberbox.diagnosis.faulttree.decision_diagrams import MOST_NODES
from amberbox.diagnosis.faulttree.open_psa import read_mef, write_mef
from amberbox.diagnosis.faulttree.tree import DEFAULT_MISSION_TIME_H, FaultTree
from amberbox.diagnosis.fmea.fault_trees import (
    FACTORS,
    LISTED,
    EffectOutlook,
    analysis_json,
    closest_json,
    description,
    effects,
    effects_json,
    fault_tree_of,
    outlooks,
    smallest_cut_sets,
)
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.models import trees_of

if TYPE_CHECKING:
    from amberbox.blackbox.robot_folder.folder import RobotFolder
    from amberbox.core.types import Diagnosis
    from amberbox.diagnosis.diagnose import DiagnosisContext


_SECONDS = 15.0
_EFFECT_HEADER = ("effect", "probability", "cut sets", "of order", "smallest", "what is lost")


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
    parser.add_argument(
        "--most-probable", type=int, metavar="N",
        help="list the N most probable cut sets and their share of the probability",
    )  # fmt: skip
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
    parser.add_argument(
        "--mission-time", type=float, default=DEFAULT_MISSION_TIME_H, metavar="H",
        help="hours, for expressions of a file that use it (default: a year)",
    )  # fmt: skip
    add_seconds(parser, _SECONDS)
    parser.add_argument(
        "--nodes", type=int, default=MOST_NODES, metavar="N",
        help="give up at N nodes, up to 200 bytes each (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Solve and show; return 1 when a budget ended before completion."""
    _check(args)
    budget = budget_of(args, nodes=args.nodes)
    if is_url(args.where):
        return _run_on_server(args)
    if _is_tree(args.where):
        files = [args.where, *args.more]
        return _one(read_mef(files, args.effect, args.mission_time), args, budget)
    fmea = fmea_of(args.where)
    if args.closest:
        show_closest(fmea, args, budget)
        return 0
    if args.effect:
        return _one(_tree_of(fmea, args.effect, args), args, budget)
    if show_all(fmea, args, budget):
        return 0
    print_notes(["incomplete: --seconds and --nodes allow more"])
    return 1


def _is_tree(where: str) -> bool:
    return Path(where).suffix.lower() == ".xml"


def _one(tree: FaultTree, args: argparse.Namespace, budget: Budget) -> int:
    """Solve one tree and show it; return 1 when a budget ended before completion."""
    if args.export:
        with text_output(args.export) as file:
            file.write(write_mef(tree))
    analysis = analyse(tree, args.order, args.importance, budget)
    if args.json:
        asked = args.importance, args.cut_sets or 0, args.most_probable or 0
        made = analysis_json(analysis, *asked)
        files = {"files": [args.where, *args.more]} if args.more else {}
        print_json({"file": args.where, **files, **made})
    else:
        show(analysis, args)
    if not analysis.incomplete:
        return 0
    print_notes([f"incomplete: {analysis.incomplete}; --seconds and --nodes allow more"])
    return 1


def _check(args: argparse.Namespace) -> None:
    for name, least in (("order", 0), ("cut_sets", 1), ("most_probable", 1), ("nodes", 1)):
        given = getattr(args, name)
        if given is not None and given < least:
            raise UsageError(f"--{name.replace('_', '-')} must be {least} or more")
    for name in ("mission_time", "exposure"):
        given = getattr(args, name)
        if given is not None and not 0.0 <= given < math.inf:
            raise UsageError(f"--{name.replace('_', '-')} must be a number, 0 or more")
    if args.more and not all(map(_is_tree, (args.where, *args.more))):
        raise UsageError("several can be given of FILE.xml only", "amberbox faulttree A.xml B.xml")
    if _is_tree(args.where):
        if args.exposure is not None:
            what = "--exposure is for failure modes; a file has its own probabilities"
            raise UsageError(what, "--mission-time is what expressions of a file are computed with")
        if args.closest or args.at:
            raise UsageError(
                "only of a robot folder is known what is close", "amberbox faulttree WHERE"
            )
    else:
        _check_compiled(args)


def _check_compiled(args: argparse.Namespace) -> None:
    if args.export and (args.closest or not args.effect):
        raise UsageError("one tree can be exported at a time", "name it: --effect NAME")
    if args.at and not args.closest:
        raise UsageError("--at is for --closest", "amberbox faulttree WHERE --closest --at T")
    if args.mission_time != DEFAULT_MISSION_TIME_H:
        raise UsageError("--mission-time is for expressions of a file", "--exposure H")
    if args.closest and args.importance:
        raise UsageError("--closest shows no importance", "leave out one of them")


def show(analysis: Analysis, args: argparse.Namespace) -> None:
    """Print an analysis as text."""
    tree = analysis.tree
    size = f"{len(analysis.gates)} gates, {len(analysis.events)} basic events"
    print_lines([f"{called(tree, tree.top)}: {size}"])
    if not analysis.coherent:
        print("not coherent: cut sets are the positive parts of the minimal solutions")
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
    elif analysis.bounds is not None:
        lower, upper = analysis.bounds.lower, analysis.bounds.upper
        print(f"probability: between {lower:.10g} and {upper:.10g}")
    _show_cut_sets(analysis, args.cut_sets or 0)
    if args.most_probable or analysis.probable is not None:
        _show_most_probable(analysis, args.most_probable or LISTED)
    if analysis.importance:
        print()
        rows = [_importance_row(tree, event, entry) for event, entry in analysis.importance.items()]
        print_grid(("event", *(name.upper() for name in FACTORS)), rows)


def _show_cut_sets(analysis: Analysis, count: int) -> None:
    if analysis.by_order is None:
        return
    print(f"minimal cut sets: {analysis.minimal_cut_sets:,}{limit_note(analysis.truncated_at)}")
    for order, number in enumerate(analysis.by_order):
        if number:
            print(f"  order {order}: {number:,}")
    for entry in smallest_cut_sets(analysis, count):
        print_lines(["  {" + ", ".join(called(analysis.tree, e) for e in sorted(entry)) + "}"])


def _show_most_probable(analysis: Analysis, count: int) -> None:
    found = most_probable(analysis, count)
    if found is None:
        return
    kind = "smallest" if found.probabilities is None else "most probable"
    share = ""
    if found.share is not None:
        low, high = (f"{100 * part:.3g} %" for part in found.share)
        share = f", {low if low == high else f'{low} to {high}'} of the probability"
    sure = ""
    if found.certain < len(found.sets):
        sure = f"; of the first {found.certain} it is sure that no other one is more probable"
    print(f"{kind} minimal cut sets: {len(found.sets):,}{share}{sure}")
    for place, events in enumerate(found.sets):
        named = ", ".join(called(analysis.tree, event) for event in sorted(events))
        chance = f"{found.probabilities[place]:.4g}  " if found.probabilities else ""
        print_lines([f"  {chance}{{{named}}}"])


def limit_note(limit: int | None) -> str:
    """Return the note that larger cut sets are left out; empty without a limit."""
    return "" if limit is None else f", up to order {limit}: larger ones are not counted"


def called(tree: FaultTree, name: str) -> str:
    """Return the name of a gate or event, with its label where it has one."""
    named = tree.gates.get(name) or tree.events.get(name)
    return f"{name} ({named.label})" if named is not None and named.label else name


def _importance_row(tree: FaultTree, event: str, entry: Importance) -> tuple[str, ...]:
    values = (getattr(entry, name) for name in FACTORS)
    return (called(tree, event), *(f"{value:.6g}" for value in values))


def fmea_of(where: str) -> Fmea:
    """Read the failure modes of a robot folder or a file; raise if anything is wrong."""
    fmea, _, problems = loaded(fmea_path(where))
    raise_errors(problems)
    assert fmea is not None, "a file without errors has been read"
    return fmea


def analysed(fmea: Fmea, effect: str, args: argparse.Namespace, budget: Budget) -> Analysis:
    """Solve the fault tree of one effect."""
    return analyse(_tree_of(fmea, effect, args), args.order, args.importance, budget)


def _tree_of(fmea: Fmea, effect: str, args: argparse.Namespace) -> FaultTree:
    """Return the tree of an effect, or that of a gate in the robot folder's files."""
    trees, needs = _folder_trees(args.where), fmea.needs()
    if trees:
        hint = f"effects on the system: {', '.join((*effects(fmea), *trees))}"
        effect = component_id(effect, [*needs, *trees], kind="effect", hint=hint)
    if effect in trees and effect not in needs:
        return trees[effect]
    return fault_tree_of(fmea, effect, args.exposure)


@lru_cache(maxsize=1)
def _folder_trees(where: str) -> Mapping[str, FaultTree]:
    return trees_of(Path(where)) if Path(where).is_dir() else {}


def show_all(fmea: Fmea, args: argparse.Namespace, budget: Budget) -> bool:
    """Show all effects on the system; return whether all were completed."""
    names = list(dict.fromkeys((*effects(fmea), *_folder_trees(args.where))))
    found = [
        analysed(fmea, effect, args, budget.turn(len(names) - place))
        for place, effect in enumerate(names, 1)
    ]
    if not found:
        print_notes(
            [f"{args.where} has no functions that could be lost; --effect takes components, too"]
        )
    if args.json:
        asked = args.exposure, args.importance, args.cut_sets or 0
        print_json({"file": args.where, **effects_json(fmea, found, *asked)})
    elif args.importance or args.cut_sets:
        for place, analysis in enumerate(found):
            print("\n" * (place > 0), end="")
            show(analysis, args)
    else:
        rows = [
            _effect_row(one.tree.top, one.top_probability, _between(one), one.by_order,
                        one.minimal_cut_sets, description(fmea, one)["description"])
            for one in found
        ]  # fmt: skip
        print_grid(_EFFECT_HEADER, rows)
        if args.order is not None:
            print(f"cut sets{limit_note(args.order)}")
    return not any(analysis.incomplete for analysis in found)


def _between(analysis: Analysis) -> tuple[float, float] | None:
    bounds = analysis.bounds
    return None if bounds is None else (bounds.lower, bounds.upper)


def _effect_row(
    effect: str, chance: float | None, between: Sequence[float] | None,
    by_order: Sequence[int] | None, number: int | None, what: str,
) -> list[str]:  # fmt: skip
    """Return the row of an effect: probability, count of cut sets, and what its loss means."""
    first = [effect, "-" if chance is None else f"{chance:.3g}"]
    if chance is None and between is not None:
        first[1] = " to ".join(f"{value:.3g}" for value in between)
    if by_order is None:
        return [*first, "-", "-", "-", what]
    counts = {order: count for order, count in enumerate(by_order) if count}
    orders = ", ".join(f"{order}: {count:,}" for order, count in counts.items())
    smallest = str(min(counts)) if counts else "-"
    return [*first, f"{number:,}", orders or "-", smallest, what]


_LISTED = 3
_LOOKBACK_S = 600.0


def show_closest(fmea: Fmea, args: argparse.Namespace, budget: Budget) -> None:
    """Show the closest cut sets of each effect, the closest effect first."""
    names = (args.effect,) if args.effect else effects(fmea)
    solved = [analysed(fmea, name, args, budget) for name in names]
    at_ns, diagnosis = _standing(args)
    count = args.cut_sets or _LISTED
    found = outlooks(solved, diagnosis, count)
    if args.json:
        print_json({"file": args.where, **closest_json(fmea, at_ns, diagnosis, found)})
        return
    print(_heading(at_ns, diagnosis))
    for outlook in found:
        print_lines(_outlook_lines(outlook))
    if args.order is not None:
        print(f"\ncut sets{limit_note(args.order)}")


def _standing(args: argparse.Namespace) -> tuple[int | None, Diagnosis | None]:
    """Return the instant (ns) and the open diagnosis at it; None without a record."""
    from amberbox.blackbox.robot_folder.folder import load_folder, store_of
    from amberbox.blackbox.store.store import is_store

    store = store_of(Path(args.where)) if Path(args.where).is_dir() else None
    if store is None or not is_store(store):
        if args.at:
            raise UsageError(f"there is no record in {args.where}", "leave out --at")
        return None, None
    folder = load_folder(args.where)
    with opened(args.where) as record:
        at_ns = time_of("--at", args.at, record.time_ns)
        if at_ns is None:
            at_ns = record.last_ns()
    if at_ns is None:
        return None, None
    return at_ns, _context_at(folder, at_ns, args.exposure).open


def _context_at(folder: RobotFolder, at_ns: int, exposure_h: float | None) -> DiagnosisContext:
    """Return the diagnosis context at an instant."""
    from amberbox.blackbox.store.store import open_store
    from amberbox.consult.context import context_at
    from amberbox.consult.folder_knowledge import load_knowledge
    from amberbox.monitoring.plan_loader import load_plan

    plan, _ = load_plan(folder)
    knowledge, _ = load_knowledge(folder, plan, exposure_h)
    assert knowledge is not None, "the failure modes have been read before"
    store = open_store(folder.store_path)
    return context_at(knowledge, plan, store, at_ns, _LOOKBACK_S, folder.path)


def _heading(at_ns: int | None, diagnosis: Diagnosis | None) -> str:
    if at_ns is None:
        return "nothing is recorded: only what is known beforehand counts"
    if diagnosis is None:
        return f"no diagnosis at {format_time(at_ns)}: only what is known beforehand counts"
    leading = diagnosis.hypotheses[:1]
    names = [f"{entry.id} ({entry.probability:.0%})" for entry in leading]
    return f"{format_time(at_ns)}, {diagnosis.id}: {', '.join(names) or 'no hypothesis'}"


def _outlook_lines(outlook: EffectOutlook) -> Iterator[str]:
    yield f"\n{called(outlook.analysis.tree, outlook.analysis.tree.top)}"
    for near in outlook.near:
        parts = (("happened", near.happened), ("missing", near.missing))
        named = (f"{what}: {_named(near, events)}" for what, events in parts if events)
        yield f"  {near.probability:.3g}  {'; '.join(named)}"
    if not outlook.near:
        yield "  nothing can lead to it"


def _named(near: NearCutSet, events: tuple[str, ...]) -> str:
    return ", ".join(f"{name} ({near.events[name]:.2g})" for name in events)


def _run_on_server(args: argparse.Namespace) -> int:
    """Show the trees of all functions, of one, or which cut sets are closest to complete."""
    refuse_options(args.where, {"export": args.export}, FOR_LOCAL_FOLDER)
    if args.at and not args.closest:
        raise UsageError("--at is for --closest", "amberbox faulttree URL --closest --at T")
    if args.importance and not args.effect:
        raise UsageError("a server tells of one function what matters", "--effect NAME")
    check_time("--at", args.at)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.faulttrees(
            robot, args.effect, cut_sets=args.cut_sets or 0, order=args.order, at=args.at,
            exposure_h=args.exposure, most_probable=args.most_probable or 0,
        )  # fmt: skip
    print_notes(found["notes"])
    if args.json:
        print_json(found)
    elif args.closest:
        print("\n".join(_server_closest_lines(found, args.cut_sets or _LISTED)))
    elif args.effect:
        print("\n".join(_server_tree_lines(found, importance=args.importance)))
    else:
        columns = ("effect", "top_probability", "probability_bounds", "by_order",
                   "minimal_cut_sets", "description")  # fmt: skip
        rows = [_effect_row(*(one[name] for name in columns)) for one in found["effects"]]
        print_grid(_EFFECT_HEADER, rows)
    if found.get("incomplete"):
        print_notes(["incomplete: the server gave up after its time"])
        return 1
    return 0


def _server_tree_lines(found: Mapping[str, Any], *, importance: bool) -> Iterator[str]:
    size = f"{found['gates']} gates, {found['basic_events']} basic events"
    yield f"{found['effect']} ({found['description']}): {size}"
    if found["top_probability"] is not None:
        yield f"probability: {found['top_probability']:.10g} (exact)"
    elif found.get("probability_bounds"):
        lower, upper = found["probability_bounds"]
        yield f"probability: between {lower:.10g} and {upper:.10g}"
    if found["by_order"] is not None:
        yield f"minimal cut sets: {found['minimal_cut_sets']:,}"
        counts = enumerate(found["by_order"])
        yield from (f"  order {order}: {count:,}" for order, count in counts if count)
    yield from ("  {" + ", ".join(entry) + "}" for entry in found.get("cut_sets", ()))
    yield from _probable_lines(found.get("most_probable"))
    if importance and found["importance"]:
        yield ""
        for event, factors in found["importance"].items():
            values = (f"{k.upper()} {'-' if v is None else f'{v:.6g}'}" for k, v in factors.items())
            yield f"{event}: {', '.join(values)}"


def _probable_lines(best: Mapping[str, Any] | None) -> Iterator[str]:
    if best is None:
        return
    share = ""
    if best["share"] is not None:
        low, high = best["share"]
        share = f", {100 * low:.3g} % to {100 * high:.3g} % of the probability"
    yield f"most probable minimal cut sets: {len(best['cut_sets']):,}{share}"
    for entry in best["cut_sets"]:
        chance = "" if entry["probability"] is None else f"{entry['probability']:.4g}  "
        yield f"  {chance}{{{', '.join(entry['events'])}}}"


def _server_closest_lines(found: Mapping[str, Any], count: int) -> Iterator[str]:
    standing = found["diagnosis"]
    yield f"{found['at']}, {standing or 'no diagnosis: only what is known beforehand counts'}"
    for effect in found["closest"]:
        yield f"\n{effect['effect']}"
        for near in effect["closest"][:count]:
            parts = (("happened", near["happened"]), ("missing", near["missing"]))
            shown = (f"{what}: {', '.join(events)}" for what, events in parts if events)
            yield f"  {near['probability']:.3g}  {'; '.join(shown)}"
