"""Operations of worker processes on a robot's knowledge: diagnoses, failure modes, trees, rules.

A worker has a limit of time and memory, which also ends rules that do not terminate. Paths in
answers are relative to the robot's folder.
"""

from __future__ import annotations

import json
import re
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
from sqlalchemy import func, select

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.blackbox.retention.missions import RecordedMission
from amberbox.consult.context import RobotWindow, context_from_findings
from amberbox.consult.folder_knowledge import DeclaredRobot, read_declared_robot
from amberbox.consult.rule_lookups import record_predicates
from amberbox.consult.run_answers import answers_to
from amberbox.core.config import raise_errors
from amberbox.core.contracts import Budget, GivenEvidence, Span
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.names import component_id
from amberbox.core.timestamps import format_time, ordered_span, parse_time
from amberbox.core.types import Output, Status, Symptom, SymptomState
from amberbox.diagnosis.diagnose import (
    DiagnosisContext,
    ObservedSituation,
    diagnose_with_evidence,
    observe,
)
from amberbox.diagnosis.evidence.rules import Facts, known_facts
from amberbox.diagnosis.faulttree.analysis import Analysis, analyse
from amberbox.diagnosis.faulttree.tree import FaultTree
from amberbox.diagnosis.fmea.criticality import coverage
from amberbox.diagnosis.fmea.fault_trees import (
    closest_json,
    effect_json,
    effects,
    effects_json,
    fault_tree_of,
    outlooks,
)
from amberbox.diagnosis.fmea.model import Fmea
from amberbox.diagnosis.fmea.sheet import coverage_json, criticality_json, table_json
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.models import trees_of
from amberbox.diagnosis.prolog.program import read_rules
from amberbox.diagnosis.prolog.query import ask
from amberbox.diagnosis.report.serialiser import context_json, explain_context, with_end_times
from amberbox.diagnosis.report.wording import FaultNames
from amberbox.diagnosis.symptom_presence import SymptomPresences
from amberbox.monitoring.current_state import RecordedFindings
from amberbox.monitoring.mode_evaluation import meets
from amberbox.monitoring.plan import Expectation, ModePlan, MonitoringPlan, measured_from
from amberbox.server.archive.catalogue import ArchiveCatalogue
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.record import ArchiveRecord
from amberbox.server.data.missions import OpenedStores, missions
from amberbox.server.data.snapshot import open_catalogue
from amberbox.server.database import ServerDatabase
from amberbox.server.derived import MOST, derived_records
from amberbox.server.drawing.faulttree import tree_drawing
from amberbox.server.ingest.folders import FOLDERS, FolderStore
from amberbox.server.knowledge.diagnoses import (
    EvidenceMoment,
    evidence_at,
    find_diagnosis,
    newest_diagnosis,
)
from amberbox.server.knowledge.questions import (
    AskDiagnosis,
    AskRules,
    AskRunAnswers,
    AskTrees,
    RobotQuestion,
    decode_question,
)
from amberbox.server.schema import FOLDER, JOURNALS, ROBOT, ROW

Op: TypeAlias = Callable[[Path, dict[str, Any]], bytes]


def json_operation(answer: Callable[[Path, dict[str, Any]], Any]) -> Op:
    """Make a worker operation of a function: JSON answers, and errors, without server paths."""

    @wraps(answer)
    def op(folder: Path, arguments: dict[str, Any]) -> bytes:
        try:
            found = answer(folder, arguments)
        except AmberboxError as error:
            kind = UsageError if isinstance(error, UsageError) else AmberboxError
            what, hint = (without_paths(folder, text) for text in (error.what, error.hint))
            raise kind(what, hint) from error
        text = json.dumps(found, ensure_ascii=False, allow_nan=False)
        return without_paths(folder, text).encode("utf-8", "backslashreplace")

    return op


def without_paths(folder: Path, text: str) -> str:
    """Return a text with paths in robots' folders made relative to the folder."""
    places = {re.escape(str(place)) for place in (folder, folder.absolute(), folder.resolve())}
    start = "|".join(sorted(places, key=len, reverse=True))
    return re.sub(rf"(?:{start})/{FOLDERS}/[a-z0-9_.-]+/[0-9a-f]{{64}}/?", "", text)


_CLOSEST = 5
_NODES = 2_000_000
_TREES_SHARE = 0.8  # of the time; the rest is for an answer when a step of the search takes long
_KEPT = 32
"""Trees that are kept solved; each can have many nodes."""
_SOLVED: OrderedDict[tuple[object, ...], Analysis] = OrderedDict()


@json_operation
def diagnose(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the diagnosis of a robot with its explanation."""
    return answer_diagnosis(folder, opened_stores(folder), decode_question(arguments, AskDiagnosis))


@json_operation
def fmea(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the FMEA table, criticality and detection coverage."""
    asked = decode_question(arguments, RobotQuestion)
    stores = opened_stores(folder)
    subject, notes = folder_at(
        folder, stores.database, asked.robot, asked.config_hash, watched_hash(stores, asked)
    )
    found = subject.faults()
    return {
        "robot": asked.robot,
        "config_hash": subject.folder.config_hash,
        "name": found.name,
        "table": table_json(found),
        "criticality": criticality_json(found, asked.exposure_h),
        "symptoms": {name: FaultNames(found).symptom(name) for name in found.symptoms},
        "coverage": coverage_json(coverage(found, sorted(subject.known.watched))),
        "notes": list(notes),
    }  # fmt: skip


@json_operation
def fault_trees(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the fault trees of all functions, or one with its cut sets and those closest to
    complete.
    """
    return _trees(folder, opened_stores(folder), decode_question(arguments, AskTrees))


def _trees(folder: Path, stores: OpenedStores, asked: AskTrees) -> dict[str, Any]:
    then = evidence_at(stores, asked.robot, asked.at, asked.now_ns)
    subject, notes = folder_at(
        folder,
        stores.database,
        asked.robot,
        asked.config_hash,
        then.config_hash if asked.at else "",
    )
    known, trees = _sources(subject)
    names = _effects(known, trees, asked.effect)
    one, budget = bool(asked.effect), tree_budget(_TREES_SHARE * asked.seconds)
    solved = [
        _solved(subject, name, asked, budget.turn(len(names) - place), with_sets=one)
        for place, name in enumerate(names, 1)
    ]
    shown = (
        effect_json(known, solved[0], True, asked.cut_sets, asked.most_probable)
        if one
        else effects_json(known, solved, asked.exposure_h, probable=asked.most_probable)
    )
    standing = _standing(then.findings.diagnoses)
    with_chances = [one for one in solved if not one.without_probability]
    found = outlooks(with_chances, standing, _CLOSEST)
    closest = closest_json(known, then.at_ns, standing, found)
    about = {"robot": asked.robot, "config_hash": subject.folder.config_hash}
    return {
        **about, **shown, "at": format_time(then.at_ns), "closest": closest["effects"],
        "diagnosis": closest["diagnosis"], "notes": [*then.notes, *notes],
    }  # fmt: skip


def _sources(subject: DeclaredRobot) -> tuple[Fmea, Mapping[str, FaultTree]]:
    """Return the failure modes and the trees of a folder; one of them may be empty."""
    trees = _folder_trees(subject.folder.path)
    bare = subject.fmea is None and not subject.problems and trees
    return (Fmea("", {}, {}, {}, {}) if bare else subject.faults()), trees


@lru_cache(maxsize=4)
def _folder_trees(place: Path) -> Mapping[str, FaultTree]:
    """Return the trees of a folder's files, cached: the content behind a hash never changes."""
    return trees_of(place)


def _tree_of(subject: DeclaredRobot, name: str, exposure_h: float | None) -> FaultTree:
    known, trees = _sources(subject)
    if name in trees and name not in known.needs():
        return trees[name]
    return fault_tree_of(known, name, exposure_h)


def tree_budget(seconds: float) -> Budget:
    """Return a budget that ends after so much time, and leaves half of it for bounds."""
    began_s = time.monotonic()

    def is_past(share: float) -> bool:
        return time.monotonic() >= began_s + share * seconds

    return Budget(_NODES, lambda: is_past(1.0), is_past=is_past)


def _solved(
    subject: DeclaredRobot, name: str, asked: AskTrees, budget: Budget, *, with_sets: bool
) -> Analysis:
    """Solve a fault tree, cached by folder: the content behind a hash never changes."""
    key = (asked.robot, subject.folder.config_hash, name, asked.exposure_h, asked.order, with_sets)
    found = _SOLVED.get(key)
    if found is None:
        tree = _tree_of(subject, name, asked.exposure_h)
        found = analyse(tree, asked.order, with_sets, budget)
        _SOLVED[key] = found
    while len(_SOLVED) > _KEPT:
        _SOLVED.popitem(last=False)
    return found


@json_operation
def one_tree(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return one fault tree, solved, with its gates and events as ``server.drawing`` draws them.

    Only this tree is solved; without a function, the first. ``functions`` lists all, by id and in
    words.
    """
    asked, stores = decode_question(arguments, AskTrees), opened_stores(folder)
    folder_hash = watched_hash(stores, asked)
    subject, _ = folder_at(folder, stores.database, asked.robot, asked.config_hash, folder_hash)
    known, trees = _sources(subject)
    every, names = _effects(known, trees, ""), FaultNames(known)
    chosen = asked.effect or next(iter(every), "")
    functions = [
        {"id": one, "text": names.function(one) if one in known.functions else _label(trees, one)}
        for one in every
    ]
    if not chosen:
        return {"functions": functions, "tree": None, "shape": None}
    _effects(known, trees, chosen)
    found = _trees(folder, stores, msgspec.structs.replace(asked, effect=chosen))
    shape = tree_drawing(_tree_of(subject, chosen, asked.exposure_h))
    return {"functions": functions, "tree": found, "shape": msgspec.to_builtins(shape)}


@json_operation
def rules(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return all answers of the robot's rules and record to a goal."""
    asked, stores = decode_question(arguments, AskRules), opened_stores(folder)
    subject, notes = folder_at(folder, stores.database, asked.robot, asked.config_hash, "")
    program = read_rules(subject.rules())
    raise_errors(program.problems())
    last_ns = evidence_at(stores, asked.robot, "", asked.now_ns).at_ns
    span = ordered_span(*(_time(text, asked.now_ns, last_ns) for text in (asked.from_, asked.to)))
    window = open_window(stores, asked.robot, *span)
    facts = tuple(known_facts(asked.robot, subject.fmea, asked.exposure_h))
    program = Facts(facts, (), tuple(record_predicates(window))).added_to(program)
    budget = Budget(steps=asked.steps or Budget().steps, is_over=ends(asked.seconds))
    found = ask(program, asked.query, budget, asked.want or None)
    about = {"robot": asked.robot, "config_hash": subject.folder.config_hash}
    more_notes = [str(note) for note in program.notes]
    more_notes += _not_looked_at(stores, asked, subject.rules())
    return {**about, **found.to_json(), "notes": [*notes, *more_notes]}


def _not_looked_at(stores: OpenedStores, asked: AskRules, files: Iterable[Path]) -> list[str]:
    """Return notes on journals that conditions cannot read yet because no table holds them."""
    catalogue = ArchiveCatalogue(stores.database)
    waiting = sum(row.robot == asked.robot for row in catalogue.waiting())
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in files)
    if not waiting or not any("holds" in text for text in (asked.query, *texts)):
        return []
    count = "a journal waits" if waiting == 1 else f"{waiting} journals wait"
    return [f"{count} for the next commit: conditions (holds) do not see what is in there yet"]


@json_operation
def failure_modes(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return the ids of all failure modes in a robot's folder at a time."""
    asked, stores = decode_question(arguments, RobotQuestion), opened_stores(folder)
    subject, _ = folder_at(
        folder, stores.database, asked.robot, asked.config_hash, watched_hash(stores, asked)
    )
    return sorted(subject.faults().modes)


@json_operation
def run_answers(folder: Path, arguments: dict[str, Any]) -> Any:
    """Return what a finished run answers to the open diagnosis of a robot: its id, and answers."""
    asked, stores = decode_question(arguments, AskRunAnswers), opened_stores(folder)
    if asked.diagnosis:
        known = find_diagnosis(stores, asked.robot, asked.diagnosis)
    else:
        known = newest_diagnosis(stores, asked.robot)
    if known is None or known.last.state != "open":
        return {"diagnosis": "", "answers": {}}
    subject, _ = folder_at(folder, stores.database, asked.robot, known.last.config_hash, "")
    given = (
        {}
        if subject.fmea is None
        else answers_to(known.last, subject.knowledge(), asked.kind, asked.name, asked.verdict)
    )
    return {"diagnosis": known.id, "answers": given}


def opened_stores(folder: Path) -> OpenedStores:
    """Return what is stored in a server's data folder."""
    database = open_catalogue(folder).database
    return OpenedStores(database, FolderArchive(folder, database))


def watched_hash(stores: OpenedStores, asked: RobotQuestion) -> str:
    """Return the hash of the folder that the watcher used at the time asked for, or empty."""
    return evidence_at(stores, asked.robot, asked.at, asked.now_ns).config_hash if asked.at else ""


def _effects(known: Fmea, trees: Mapping[str, FaultTree], effect: str) -> list[str]:
    """Return the names of all trees, or of the one asked for."""
    if not effect:
        return list(dict.fromkeys((*effects(known), *trees)))
    every = [*known.functions, *known.components, *trees]
    return [component_id(effect, every, kind="function")]


def _label(trees: Mapping[str, FaultTree], top: str) -> str:
    """Return the name of a tree of a file for people."""
    return trees[top].gates[top].label or top


def _standing(diagnoses: Any) -> Any:
    """Return the last diagnosis if it is open, else None."""
    last = diagnoses[-1] if diagnoses else None
    return last if last is not None and last.state == "open" else None


def _time(text: str, now_ns: int, last_ns: int) -> int | None:
    return parse_time(text, lambda: now_ns, lambda: last_ns) if text else None


def ends(seconds: float) -> Callable[[], bool]:
    """Return a function that is true once so much time is over."""
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() > end_s


_SHOWN = 12


def folder_at(
    folder: Path, database: ServerDatabase, robot: str, wanted: str, watched: str
) -> tuple[DeclaredRobot, tuple[str, ...]]:
    """Return the contents of a robot's folder, and notes about its version; see ``place_at``."""
    place = place_at(folder, database, robot, wanted, watched)
    found = _read(place, robot, place.name)
    if not watched or watched == place.name:
        return found, ()
    return found, (f"its watcher had the folder {watched[:_SHOWN]} then, not this one",)


def place_at(folder: Path, database: ServerDatabase, robot: str, wanted: str, watched: str) -> Path:
    """Return where a robot's folder is stored; the last part of the path is its hash.

    ``wanted`` is the hash that the caller asks for, ``watched`` the one that the robot's watcher
    used at the time; without either it is the folder that the robot stated last. Raises UsageError
    if the server has no such folder: another one would describe other monitors than those that ran.
    """
    shelf, config_hash = FolderStore(folder), wanted or watched or _stated(database, robot)
    place = shelf.place(robot, config_hash) if config_hash else None
    if place is None or not place.is_dir():
        raise _not_here(database, robot, config_hash)
    return place


@lru_cache(maxsize=4)
def _read(place: Path, robot: str, config_hash: str) -> DeclaredRobot:
    """Read a folder, cached per worker: the content behind a hash never changes."""
    return read_declared_robot(place, robot, config_hash)


def _stated(database: ServerDatabase, robot: str) -> str:
    chosen = select(ROBOT.c.config_hash).where(ROBOT.c.robot == robot)
    with database.reading() as connection:
        stated = str(connection.execute(chosen).scalar() or "")
        known = connection.execute(
            select(FOLDER.c.config_hash)
            .where(FOLDER.c.robot == robot)
            .order_by(FOLDER.c.received_ns.desc())
        )
        hashes = [str(name) for name in known.scalars()]
    return stated if stated in hashes or not hashes else hashes[0]


def _not_here(database: ServerDatabase, robot: str, config_hash: str) -> UsageError:
    chosen = select(FOLDER.c.config_hash).where(FOLDER.c.robot == robot)
    with database.reading() as connection:
        known = [str(name)[:_SHOWN] for name in connection.execute(chosen).scalars()]
    what = f"the folder that {robot} had then is not here"
    if not config_hash:
        what = f"the folder of {robot} has not come yet"
    elif known:
        return UsageError(
            f"{what}: {config_hash[:_SHOWN]}", f"name another one to ask with: {', '.join(known)}"
        )
    return UsageError(what, "it sends its folder when it connects, if its Amberbox is new enough")


_Run = tuple[str, int]


def open_window(
    stores: OpenedStores, robot: str, from_ns: int | None, to_ns: int | None
) -> ServerWindow:
    """Open a window of a robot's record on the server."""
    record = stores.archive.robot(robot)
    return ServerWindow(record=record, from_ns=from_ns, to_ns=to_ns, stores=stores, robot=robot)


@dataclass(frozen=True, kw_only=True)
class ServerWindow(RecordWindow):
    """A window of a robot's record, read from the server's stores."""

    record: ArchiveRecord
    stores: OpenedStores
    robot: str

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield the rows of a channel, of which also the newest have come, or of an item."""
        if topic not in channels.names():
            yield from super().rows(topic, names, span)
            return
        for entry in derived_records(self.stores, self.robot, topic, span, MOST):
            yield {"received": entry.at_ns, **dict.fromkeys(names), **entry.values}

    def missions(self) -> list[RecordedMission]:
        """Return all missions of the robot that the server knows."""
        return missions(self.record.path, self.robot)

    def _runs(self, writers: Collection[str]) -> tuple[Span, ...]:
        found: dict[_Run, Span] = {}
        for run, first, last in (*self._journals(writers), *self._link(writers)):
            known = found.get(run, (first, last))
            found[run] = min(known[0], first), max(known[1], last)
        return tuple(sorted((first, last + 1) for first, last in found.values()))

    def _journals(self, writers: Collection[str]) -> Iterator[tuple[_Run, int, int]]:
        of = JOURNALS.c
        chosen = select(of.store_id, of.run, func.min(of.start_ns), func.max(of.end_ns))
        chosen = chosen.where(of.robot == self.robot, of.writer.in_(writers), of.rows > 0)
        with self.stores.database.reading() as connection:
            for row in connection.execute(chosen.group_by(of.store_id, of.run)):
                yield (row[0], row[1]), int(row[2]), int(row[3])

    def _link(self, writers: Collection[str]) -> Iterator[tuple[_Run, int, int]]:
        of = ROW.c
        chosen = select(of.store_id, of.run, func.min(of.log_ns), func.max(of.log_ns))
        chosen = chosen.where(of.robot == self.robot, of.writer.in_(writers))
        with self.stores.database.reading() as connection:
            for row in connection.execute(chosen.group_by(of.store_id, of.run)):
                yield (row[0], row[1]), int(row[2]), int(row[3])


SOURCE = "monitor"


def status_symptoms(plan: MonitoringPlan, statuses: Iterable[Status]) -> Iterator[Symptom]:
    """Yield a symptom for each output of a mode, by the expectations of the component files.

    The symptoms of a status that is stale or unknown are ``unknown``.
    """
    modes = {(component.id, mode.id): mode for component, mode in plan.modes()}
    for status in statuses:
        mode = modes.get((status.component, status.mode))
        if mode is not None:
            yield from _of_mode(mode, status)


def _of_mode(mode: ModePlan, status: Status) -> Iterator[Symptom]:
    outputs = ((mapping, output) for mapping in mode.mappings for output in mapping.outputs)
    for mapping, output in outputs:
        if output.expectation.value is None:
            continue
        address = f"{status.component}/{mode.id}/{output.name}"
        state = _state(output.expectation, status.outputs.get(output.name), status)
        onset_ns = status.since_ns if state == "present" else None
        evidence = (
            ()
            if onset_ns is None
            else tuple(
                (name, onset_ns, status.measured_ns) for name in measured_from(mapping, output)
            )
        )
        yield Symptom(
            address, state, address, onset_ns, status.measured_ns, source=SOURCE,
            evidence=evidence, blocked_by=status.blocked_by,
        )  # fmt: skip


def _state(expected: Expectation, value: Output, status: Status) -> SymptomState:
    """Return the state of a symptom: present once the value and the level of the status are bad."""
    if value is None or status.level in ("stale", "unknown"):
        return "unknown"
    try:
        is_good = bool(meets(expected, value))
    except TypeError:
        return "unknown"  # the value had another type at the time
    return "absent" if is_good or status.level == "ok" else "present"


def answer_diagnosis(folder: Path, stores: OpenedStores, asked: AskDiagnosis) -> dict[str, Any]:
    """Return the answer as ``amberbox diagnose --json`` gives it, with ``notes``."""
    then = _moment(stores, asked)
    subject, notes = folder_at(
        folder, stores.database, asked.robot, asked.config_hash, then.config_hash
    )
    knowledge = subject.knowledge(asked.exposure_h)
    case = _case(knowledge, subject, then)
    if asked.diagnosis and not asked.at:
        case = _as_revised(case)
    window = partial(
        RobotWindow,
        folder=subject.folder.path,
        given=GivenEvidence(_texts(asked.symptoms), _texts(asked.answers)),
        open_past=partial(open_window, stores, asked.robot),
    )
    case = observe(knowledge, case, window)
    left_out: list[str] = []  # providers that fail are notes here, errors in the CLI
    case, diagnosis = diagnose_with_evidence(knowledge, case, window, asked.engine, left_out)
    explanation = explain_context(knowledge, case, diagnosis)
    answer = context_json(knowledge, case, diagnosis, explanation)
    return {**answer, "engine": asked.engine, "notes": [*then.notes, *notes, *left_out]}


def _moment(stores: OpenedStores, asked: AskDiagnosis) -> EvidenceMoment:
    """Return the evidence at the time asked for.

    For an earlier diagnosis without a time, that is the time of its chosen or last revision.
    """
    if not asked.diagnosis:
        return evidence_at(stores, asked.robot, asked.at, asked.now_ns)
    known = find_diagnosis(stores, asked.robot, asked.diagnosis)
    if known is None:
        raise UsageError(f"{asked.robot} has no diagnosis '{asked.diagnosis}'")
    if not asked.at:
        last_ns = (known.until(asked.revision) if asked.revision else known).last.at_ns
        return evidence_at(stores, asked.robot, format_time(last_ns), asked.now_ns, last_ns)
    return evidence_at(stores, asked.robot, asked.at, asked.now_ns)


def _case(knowledge: Knowledge, subject: DeclaredRobot, then: EvidenceMoment) -> DiagnosisContext:
    """Return the context from the watcher's findings, else from its statuses alone."""
    findings = _known(knowledge, then.findings)  # the CLI does not filter the watcher's symptoms
    case = context_from_findings(knowledge, findings, then.at_ns)
    if case is not None:
        return replace(case, origin="watcher")
    symptoms = tuple(status_symptoms(subject.plan, then.statuses))
    if not symptoms:
        return DiagnosisContext(then.at_ns)
    known = tuple(s for s in symptoms if s.id in knowledge.fmea.symptoms)
    return DiagnosisContext(
        then.at_ns, ObservedSituation(known, watched=True), origin="status", has_more=True
    )


def _as_revised(case: DiagnosisContext) -> DiagnosisContext:
    """Set the symptoms of the robot's own revision as present and all others as not present.

    The reports by which a symptom was dropped before that revision may never have arrived.
    """
    if case.open is None:
        return case
    names = frozenset(case.open.symptoms)
    counting = case.situation.symptoms
    present = {s.id: s for s in (*case.seen, *counting) if s.state == "present"}
    shown = (present.get(name, Symptom(name, "present", name)) for name in case.open.symptoms)
    there = tuple(replace(one, blocked_by=()) for one in with_end_times(shown, counting))
    rest = (
        replace(symptom, state="unknown") if symptom.state == "present" else symptom
        for symptom in counting if symptom.id not in names
    )  # fmt: skip
    return replace(case, situation=replace(case.situation, symptoms=(*there, *rest)))


def _known(knowledge: Knowledge, findings: RecordedFindings) -> RecordedFindings:
    """Return the findings without symptoms that this folder's FMEA does not know."""
    presences = SymptomPresences(knowledge.fmea)
    known = [symptom for symptom in findings.symptoms if presences.knows(symptom.id)]
    return RecordedFindings(known, findings.diagnoses)


def _texts(given: dict[str, Any]) -> list[str]:
    return [f"{name}={word}" for name, word in given.items()]
