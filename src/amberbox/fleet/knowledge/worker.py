"""What is asked of robots' knowledge, in a worker: rules that never end do no harm there."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgspec

from amberbox.consult.closest import closest_json, outlooks
from amberbox.consult.declared import Declared
from amberbox.consult.facts import known_facts, lookups
from amberbox.consult.faulttrees import effect_json, effects_json
from amberbox.consult.sheets import coverage_json, criticality_json, table_json
from amberbox.core.config import refuse
from amberbox.core.naming import component_named
from amberbox.core.timetext import format_time, in_order, parse_time
from amberbox.diagnosis.explanation.names import Names
from amberbox.diagnosis.faulttree import Analysis, analyse
from amberbox.diagnosis.faulttree import Budget as TreeBudget
from amberbox.diagnosis.findings.facts import Facts
from amberbox.diagnosis.fmea.coverage import coverage
from amberbox.diagnosis.fmea.trees import effects, fault_tree_of
from amberbox.diagnosis.rules import Budget, ask, read_rules
from amberbox.fleet.archive.catalogue import Catalogue
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.data.look import open_catalogue
from amberbox.fleet.data.recorded import Stores
from amberbox.fleet.drawing.branches import tree_of
from amberbox.fleet.knowledge import diagnosing
from amberbox.fleet.knowledge.asked import AboutRobot, AskDiagnosis, AskRules, AskTrees, read
from amberbox.fleet.knowledge.moment import moment
from amberbox.fleet.knowledge.past import past_of
from amberbox.fleet.knowledge.spoken import spoken
from amberbox.fleet.knowledge.then import folder_of_then

_CLOSEST = 5
_NODES = 2_000_000
_KEPT = 8
"""Trees that are kept solved; each can have many nodes."""
_SOLVED: OrderedDict[tuple[object, ...], Analysis] = OrderedDict()


@spoken
def diagnose(folder: Path, arguments: dict[str, Any]) -> Any:
    """Answer what is broken."""
    return diagnosing.answered(folder, _stores(folder), read(arguments, AskDiagnosis))


@spoken
def fmea(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the sheet, what matters most and what nobody sees."""
    asked = read(arguments, AboutRobot)
    stores = _stores(folder)
    subject, notes = folder_of_then(
        folder, stores.database, asked.robot, asked.config_hash, _said(stores, asked)
    )
    found = subject.faults()
    return {
        "robot": asked.robot,
        "config_hash": subject.folder.config_hash,
        "name": found.name,
        "table": table_json(found),
        "criticality": criticality_json(found, asked.exposure_h),
        "symptoms": {name: Names(found).symptom(name) for name in found.symptoms},
        "coverage": coverage_json(coverage(found, sorted(subject.known.watched))),
        "notes": list(notes),
    }  # fmt: skip


@spoken
def fault_trees(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the trees of all functions, or one with its cut sets and how close it is now."""
    return _trees(folder, _stores(folder), read(arguments, AskTrees))


def _trees(folder: Path, stores: Stores, asked: AskTrees) -> dict[str, Any]:
    then = moment(stores, asked.robot, asked.at, asked.now_ns)
    subject, notes = folder_of_then(
        folder,
        stores.database,
        asked.robot,
        asked.config_hash,
        then.config_hash if asked.at else "",
    )
    known = subject.faults()
    names = _effects(known, asked.effect)
    budget = TreeBudget(_NODES, _ends(asked.seconds))
    one = bool(asked.effect)
    solved = [_solved(subject, name, asked, budget, with_sets=one) for name in names]
    shown = (
        effect_json(known, solved[0], importance=True, cut_sets=asked.cut_sets)
        if one
        else effects_json(known, solved, asked.exposure_h)
    )
    standing = _standing(then.said.diagnoses)
    closest = closest_json(known, then.at_ns, standing, outlooks(solved, standing, _CLOSEST))
    about = {"robot": asked.robot, "config_hash": subject.folder.config_hash}
    return {
        **about, **shown, "at": format_time(then.at_ns), "closest": closest["effects"],
        "diagnosis": closest["diagnosis"], "notes": [*then.notes, *notes],
    }  # fmt: skip


def _solved(
    subject: Declared, name: str, asked: AskTrees, budget: TreeBudget, *, with_sets: bool
) -> Analysis:
    """Solve a tree, once for each folder: one that stands on the shelf never changes."""
    key = (asked.robot, subject.folder.config_hash, name, asked.exposure_h, asked.order, with_sets)
    found = _SOLVED.get(key)
    if found is None:
        tree = fault_tree_of(subject.faults(), name, asked.exposure_h)
        found = analyse(tree, asked.order, with_sets, budget)
        if not found.incomplete:
            _SOLVED[key] = found
    while len(_SOLVED) > _KEPT:
        _SOLVED.popitem(last=False)
    return found


@spoken
def one_tree(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return one tree, solved, with its gates and events as ``fleet.drawing`` draws them.

    No other one is solved. Without a function it is the first that there is; ``functions`` names
    all, by id and in words.
    """
    asked, stores = read(arguments, AskTrees), _stores(folder)
    said = _said(stores, asked)
    subject, _ = folder_of_then(folder, stores.database, asked.robot, asked.config_hash, said)
    known = subject.faults()
    every, names = _effects(known, ""), Names(known)
    chosen = asked.effect or next(iter(every), "")
    functions = [{"id": one, "text": names.function(one)} for one in every]
    if not chosen:
        return {"functions": functions, "tree": None, "shape": None}
    _effects(known, chosen)
    found = _trees(folder, stores, msgspec.structs.replace(asked, effect=chosen))
    shape = tree_of(fault_tree_of(known, chosen, asked.exposure_h))
    return {"functions": functions, "tree": found, "shape": msgspec.to_builtins(shape)}


@spoken
def rules(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return all answers of a goal to the robot's rules and its past."""
    asked, stores = read(arguments, AskRules), _stores(folder)
    subject, notes = folder_of_then(folder, stores.database, asked.robot, asked.config_hash, "")
    program = read_rules(subject.rules())
    refuse(program.problems())
    last_ns = moment(stores, asked.robot, "", asked.now_ns).at_ns
    span = in_order(*(_time(text, asked.now_ns, last_ns) for text in (asked.from_, asked.to)))
    window = past_of(stores, asked.robot, *span)
    facts = tuple(known_facts(asked.robot, subject.fmea, asked.exposure_h))
    program = Facts(facts, (), tuple(lookups(window))).added_to(program)
    budget = Budget(steps=asked.steps or Budget().steps, is_over=_ends(asked.seconds))
    found = ask(program, asked.query, budget, asked.want or None)
    about = {"robot": asked.robot, "config_hash": subject.folder.config_hash}
    told = [str(note) for note in program.notes]
    told += _not_looked_at(stores, asked, subject.rules())
    return {**about, **found.to_json(), "notes": [*notes, *told]}


def _not_looked_at(stores: Stores, asked: AskRules, files: Iterable[Path]) -> list[str]:
    """Say what conditions do not see: journals that are here, but in no table yet."""
    catalogue = Catalogue(stores.database)
    waiting = sum(row.robot == asked.robot for row in catalogue.waiting())
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in files)
    if not waiting or not any("holds" in text for text in (asked.query, *texts)):
        return []
    count = "a journal waits" if waiting == 1 else f"{waiting} journals wait"
    return [f"{count} for the next commit: conditions (holds) do not see what is in there yet"]


@spoken
def failure_modes(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the ids of all failure modes that a robot's folder knew at a time."""
    asked, stores = read(arguments, AboutRobot), _stores(folder)
    subject, _ = folder_of_then(
        folder, stores.database, asked.robot, asked.config_hash, _said(stores, asked)
    )
    return sorted(subject.faults().modes)


def _stores(folder: Path) -> Stores:
    database = open_catalogue(folder).database
    return Stores(database, FolderArchive(folder, database))


def _said(stores: Stores, asked: AboutRobot) -> str:
    """Return which folder the watcher named at the time, where one is asked about."""
    return moment(stores, asked.robot, asked.at, asked.now_ns).config_hash if asked.at else ""


def _effects(known: Any, effect: str) -> list[str]:
    names = effects(known)
    if not effect:
        return list(names)
    return [component_named(effect, [*known.functions, *known.components], kind="function")]


def _standing(diagnoses: Any) -> Any:
    """Return the diagnosis that stands: the last one, unless it has healed."""
    last = diagnoses[-1] if diagnoses else None
    return last if last is not None and last.state == "open" else None


def _time(text: str, now_ns: int, last_ns: int) -> int | None:
    return parse_time(text, lambda: now_ns, lambda: last_ns) if text else None


def _ends(seconds: float) -> Callable[[], bool]:
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() > end_s
