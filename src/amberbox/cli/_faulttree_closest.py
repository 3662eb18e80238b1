"""Which cut sets of a robot are closest to complete, by the diagnosis that stands."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._faulttree_answer import called, limit_note
from amberbox.cli._faulttree_effects import analysed
from amberbox.cli._output import opened, print_json, time_of
from amberbox.cli._text import print_lines
from amberbox.consult.closest import Outlook, closest_json, outlooks
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.diagnosis.faulttree import Budget
from amberbox.diagnosis.faulttree.nearest import Near
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.trees import effects

if TYPE_CHECKING:
    from amberbox.blackbox.folder.folder import RobotFolder
    from amberbox.consult.case import Case
    from amberbox.core.types import Diagnosis

_LISTED = 3
_LOOKBACK_S = 600.0


def show_closest(fmea: Fmea, args: argparse.Namespace, budget: Budget) -> None:
    """Show the closest cut sets of each effect, the effect that is closest first."""
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
        print_lines(_lines(outlook))
    if args.order is not None:
        print(f"\ncut sets{limit_note(args.order)}")


def _standing(args: argparse.Namespace) -> tuple[int | None, Diagnosis | None]:
    """Return the instant it is about and the open diagnosis of then; None without a record."""
    from amberbox.blackbox.folder.folder import load_folder, store_of
    from amberbox.blackbox.store import is_store

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
    return at_ns, _case(folder, at_ns, args.exposure).open


def _case(folder: RobotFolder, at_ns: int, exposure_h: float | None) -> Case:
    """Return what was known then."""
    from amberbox.blackbox.store import open_store
    from amberbox.consult.knowledge import knowledge_of
    from amberbox.consult.reading import known_at
    from amberbox.monitoring.configuration import load_plan

    plan, _ = load_plan(folder)
    knowledge, _ = knowledge_of(folder, plan, exposure_h)
    assert knowledge is not None, "the failure modes have been read before"
    store = open_store(folder.store_path)
    return known_at(knowledge, plan, store, at_ns, _LOOKBACK_S)


def _heading(at_ns: int | None, diagnosis: Diagnosis | None) -> str:
    if at_ns is None:
        return "nothing is recorded: only what is known beforehand counts"
    if diagnosis is None:
        return f"no diagnosis at {format_time(at_ns)}: only what is known beforehand counts"
    leading = diagnosis.hypotheses[:1]
    names = [f"{entry.id} ({entry.probability:.0%})" for entry in leading]
    return f"{format_time(at_ns)}, {diagnosis.id}: {', '.join(names) or 'no hypothesis'}"


def _lines(outlook: Outlook) -> Iterator[str]:
    yield f"\n{called(outlook.analysis.tree, outlook.analysis.tree.top)}"
    for near in outlook.near:
        parts = (("happened", near.happened), ("missing", near.missing))
        named = (f"{what}: {_named(near, events)}" for what, events in parts if events)
        yield f"  {near.probability:.3g}  {'; '.join(named)}"
    if not outlook.near:
        yield "  nothing can lead to it"


def _named(near: Near, events: tuple[str, ...]) -> str:
    return ", ".join(f"{name} ({near.events[name]:.2g})" for name in events)
