"""Diagnoses of a robot, from its record or its server: shown, drawn, or followed as they change."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec

from amberbox.agent.recovery import read_recovery, recovery_lines
from amberbox.agent.recovery_actions import command_lines, recovery_actions
from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.query.record_window import RecordWindow
from amberbox.blackbox.robot_folder.folder import RobotFolder, load_folder, store_of
from amberbox.blackbox.store.own_records import OwnRecords, newest_records
from amberbox.blackbox.store.store import Store, is_locked, is_store, open_store, submit
from amberbox.cli._arguments import (
    accept_relative_times,
    add_where,
    check_time,
    refuse_options,
    robot_at,
    time_of,
    user_name,
)
from amberbox.cli._output import print_json, print_lines, print_notes, text_output
from amberbox.client.address import is_url
from amberbox.client.models import time_ns
from amberbox.consult.context import RobotWindow, context_at, context_from_journal
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.clock import NS
from amberbox.core.config import raise_errors
from amberbox.core.contracts import GivenEvidence
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.timestamps import format_time, parse_duration
from amberbox.core.types import Diagnosis, Symptom
from amberbox.diagnosis.diagnose import (
    COVERING,
    DiagnosisContext,
    ObservedSituation,
    diagnose_context,
    diagnose_with_evidence,
    engine_names,
    is_fault_indicated,
    load_engine,
    observe,
)
from amberbox.diagnosis.evidence.user import parse_answers
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.report.explain import explain
from amberbox.diagnosis.report.explanation import (
    ExplainedGroup,
    Explanation,
    MemberDiagnosis,
    MemberState,
)
from amberbox.diagnosis.report.serialiser import context_json, explain_context
from amberbox.diagnosis.report.svg import as_svg
from amberbox.diagnosis.report.text import as_text
from amberbox.diagnosis.report.wording import WORTH_SHOWING, date_and_clock, sentence
from amberbox.experiments.action import read_actions
from amberbox.monitoring.current_state import (
    CHANNELS,
    WRITER,
    duration_text,
    record_end_ns,
    symptoms_and_diagnoses,
    was_watched,
)
from amberbox.monitoring.plan import MonitoringPlan
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.watcher import ANSWER_KIND

_USAGE = (
    "amberbox diagnose WHERE [--at T] [--symptom ID[=absent|unknown]]... [--answer TEST=VALUE]... "
    "[--record [--who NAME]] [--engine covering|rules|faulttree] [--follow] [--json] [--svg FILE]"
)
_LOOKBACK = "10m"
_LATE_NS = 3 * NS
_TIMES = "ISO (UTC), epoch, -10m before the last record, now or now-10m"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.usage = _USAGE
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("--folder", metavar="FOLDER", help="robot folder with fmea.yaml and "
                        "components, where WHERE is none")  # fmt: skip
    parser.add_argument("--at", metavar="T", help=f"as it was then: {_TIMES}")
    parser.add_argument("--symptom", action="append", default=[], metavar="ID[=STATE]",
                        help="take a symptom for present, or for absent or unknown")  # fmt: skip
    parser.add_argument("--answer", action="append", default=[], metavar="TEST=VALUE",
                        help="what a test gave; 'cannot' if it cannot be done")  # fmt: skip
    parser.add_argument("--record", action="store_true", help="tell the robot the answers: its "
                        "diagnosis counts them from now on, and its server has them")  # fmt: skip
    parser.add_argument("--who", default="", metavar="NAME", help="who answers; else the user")
    parser.add_argument("--engine", choices=engine_names(), default=COVERING,
                        help="who answers: all together (covering), or one alone")  # fmt: skip
    parser.add_argument("--lookback", default=_LOOKBACK, metavar="TIME", help="evaluate so much of "
                        "the record where no watcher has (default: 10m)")  # fmt: skip
    parser.add_argument("--exposure", type=float, metavar="H", help="hours since all was known to "
                        "be well, instead of the file's")  # fmt: skip
    parser.add_argument("--follow", action="store_true", help="go on with each revision that the "
                        "watcher writes, until Ctrl-C")  # fmt: skip
    parser.add_argument("--svg", metavar="FILE", help="draw why (- prints it)")
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Show the diagnosis; return 0 without a fault, 1 with one."""
    if args.exposure is not None and not 0.0 <= args.exposure < math.inf:
        raise UsageError(f"an exposure of {args.exposure:g} h cannot be", "give hours from 0")
    if args.follow and (args.at or args.symptom or args.answer or args.svg):
        raise UsageError("--follow shows what the watcher finds", "leave out the other options")
    if args.json and args.svg == "-":
        raise UsageError("--json and --svg - both print", "--svg FILE")
    if args.record and (not args.answer or args.at or args.symptom or args.follow):
        raise UsageError("--record takes the answers to tests of now", "--answer TEST=VALUE")
    if parse_duration(args.lookback) <= 0:
        raise UsageError(f"--lookback {args.lookback} is too short", f"--lookback {_LOOKBACK}")
    if is_url(args.where):
        return _run_on_server(args)
    place = Path(args.folder or args.where)
    if args.folder is None and place.exists() and store_of(place) is None:
        raise UsageError(
            f"{place} says nothing about failure modes",
            "name the robot folder, or add --folder FOLDER",
        )
    folder = load_folder(place)
    subject = _subject(args, folder)
    with _record(args.where) as record:
        if args.follow:
            return _follow(args, subject, record)
        case = _case(args, subject, record)
        if args.record:
            return _record_answers(args, subject, case, record)
        case, diagnosis = _diagnosed(args, subject, case, record)
    return _show(args, subject, case, diagnosis)


def _record_answers(
    args: argparse.Namespace, subject: DiagnosedFolder, case: DiagnosisContext,
    record: Record | None,
) -> int:  # fmt: skip
    """Leave the answers to the open diagnosis for the watcher, which writes them down."""
    if record is None or case.open is None or case.origin != "watcher":
        raise UsageError(
            f"no watcher has an open diagnosis of {args.where}",
            f"amberbox diagnose {args.where} shows what is known",
        )
    store, diagnosis = open_store(record.path), case.open.id
    for test, value in parse_answers(args.answer, subject.knowledge).items():
        given = RecordedAnswer(diagnosis, test, value, args.who or user_name())
        submit(store, ANSWER_KIND, msgspec.to_builtins(given))
    later = "" if is_locked(store, WRITER) else " as soon as amberbox watch runs on this store"
    if args.json:
        print_json({"diagnosis": diagnosis, "answers": dict(map(_answer_given, args.answer))})
    else:
        print_lines([f"the next revision of {diagnosis} will count it{later}"])
    return 0


@dataclass(frozen=True, slots=True)
class DiagnosedFolder:
    """A robot folder with its monitoring plan and its failure modes."""

    folder: RobotFolder
    plan: MonitoringPlan
    knowledge: Knowledge


def _subject(args: argparse.Namespace, folder: RobotFolder) -> DiagnosedFolder:
    plan, problems = load_plan(folder)
    errors = [problem for problem in problems if problem.is_error]
    knowledge, found = load_knowledge(folder, plan, args.exposure)
    raise_errors([problem for problem in found if problem.is_error])
    if errors:
        print_notes([f"{len(errors)} errors in the component files: amberbox check {folder.path}"])
    if knowledge is None:
        raise UsageError(
            f"{folder.path} has no fmea.yaml: nobody has said what can fail on this robot",
            "write one, see docs/robot/fmea.md; amberbox new FOLDER makes a folder with an example",
        )
    return DiagnosedFolder(folder, plan, knowledge)


@contextmanager
def _record(where: str) -> Iterator[Record | None]:
    """Open the record; yield None for a robot folder without one."""
    store = store_of(Path(where))
    if store is not None and not is_store(store):
        yield None
        return
    with open_record(where) as record:
        print_notes(record.notes)
        yield record


def _case(
    args: argparse.Namespace, subject: DiagnosedFolder, record: Record | None
) -> DiagnosisContext:
    """Return the diagnosis context, with the observations that the user adds."""
    if record is None and (args.at is not None or not args.symptom):
        raise UsageError(
            f"there is no record in {args.where}, so nobody knows any symptom",
            "say what is seen: --symptom ID, or record something first",
        )
    case = DiagnosisContext(time.time_ns()) if record is None else _read(args, subject, record)
    return observe(subject.knowledge, case, _window(args, subject, record))


def _read(args: argparse.Namespace, subject: DiagnosedFolder, record: Record) -> DiagnosisContext:
    """Return the context at an instant: from the watcher's journal, else by evaluation."""
    store, knowledge = open_store(record.path), subject.knowledge
    at_ns = record_end_ns(store) if args.at is None else time_of("--at", args.at, record.time_ns)
    at_ns = record.last_ns() if at_ns is None else at_ns
    if at_ns is None:
        return DiagnosisContext(time.time_ns())  # a record without rows
    lookback_s = parse_duration(args.lookback) / NS
    folder = subject.folder.path
    case = context_at(knowledge, subject.plan, store, at_ns, lookback_s, folder)
    if at_ns - case.at_ns > _LATE_NS:
        print_notes(
            [f"nothing was recorded after {format_time(case.at_ns)[:19]}; this is as of then"]
        )
    return case


def _follow(args: argparse.Namespace, subject: DiagnosedFolder, record: Record | None) -> int:
    """Print the current diagnosis, and each revision as it is written, until Ctrl-C."""
    if record is None:
        raise UsageError(f"there is no record in {args.where} to follow", "record something first")
    store = open_store(record.path)
    if not is_locked(store, WRITER):
        print_notes(
            [f"nobody watches, so nothing new will come: amberbox watch {subject.folder.path}"]
        )
    show = line_of if args.json else revision_text
    for diagnosis, symptoms in revisions(store):
        print(show(subject.knowledge, diagnosis, symptoms), flush=True)
    return 0


def _diagnosed(
    args: argparse.Namespace,
    subject: DiagnosedFolder,
    case: DiagnosisContext,
    record: Record | None,
) -> tuple[DiagnosisContext, Diagnosis | None]:
    """Diagnose with the chosen engine; all engines get the evidence of all providers."""
    engine = load_engine(args.engine)
    if engine is not None and engine.NO_ANSWERS and args.answer:
        # A server ignores these answers silently.
        print_notes([engine.NO_ANSWERS])
    window = _window(args, subject, record)
    return diagnose_with_evidence(subject.knowledge, case, window, args.engine)


def _window(
    args: argparse.Namespace, subject: DiagnosedFolder, record: Record | None
) -> Callable[[DiagnosisContext], RobotWindow]:
    """Return a function that opens the robot's folder and record for providers of evidence.

    A server has no --lookback; rules there look back as far as they need.
    """
    return partial(
        RobotWindow,
        folder=subject.folder.path,
        given=GivenEvidence(args.symptom, args.answer),
        open_past=None if record is None else partial(RecordWindow, record),
        lookback_ns=parse_duration(args.lookback),
    )


def _show(
    args: argparse.Namespace,
    subject: DiagnosedFolder,
    case: DiagnosisContext,
    diagnosis: Diagnosis | None,
) -> int:
    explanation = explain_context(subject.knowledge, case, diagnosis)
    # Statements of a team's robots, which a server does not add.
    explanation = with_members(subject.knowledge, case, explanation)
    if args.svg:
        _draw(args.svg, explanation)
    if args.json:
        made = context_json(subject.knowledge, case, diagnosis, explanation)
        print_json({**made, "engine": args.engine})
    elif args.svg != "-":
        states = [symptom.state for symptom in case.situation.symptoms]
        nothing = nothing_wrong(case.at_ns, states, case.situation.findings)
        ended_ns = None
        if diagnosis is not None and diagnosis.state == "healed":
            ended_ns = case.at_ns - diagnosis.at_ns
        place = str(subject.folder.path)
        print_lines([text_of(args.engine, explanation, ended_ns, nothing, place)])
        print_lines(_recovery_lines(subject, explanation))
    return int(is_fault_indicated(case, diagnosis))


def _recovery_lines(subject: DiagnosedFolder, explanation: Explanation | None) -> Iterator[str]:
    """Yield the commands that may help against the leading failure modes, and what rules do."""
    folder = subject.folder
    broken = explanation.broken if explanation is not None else None
    faults = [f.id for one in broken.members for f in one.faults] if broken is not None else []
    actions = read_actions(folder.path)[0]
    found = recovery_actions(subject.plan, subject.knowledge.fmea, actions)
    lines = [*command_lines(found, faults, str(folder.path))]
    if is_store(folder.store_path):
        lines += recovery_lines(read_recovery(open_store(folder.store_path)))
    if lines:
        yield from ("", "What the robot can do about it", *(f"  {line}" for line in lines))


def _draw(path: str, explanation: Explanation | None) -> None:
    if explanation is None:
        print_notes(["there is no diagnosis, so nothing is drawn"])
        return
    with text_output(None if path == "-" else path) as file:
        file.write(as_svg(explanation))


_POLL_S = 0.1

Known = dict[str, Symptom]


def revisions(
    store: Store, wait: Callable[[float], None] = time.sleep
) -> Iterator[tuple[Diagnosis, Known]]:
    """Yield the current diagnosis, if there is one, then each revision as it is written.

    Each comes with the symptoms known by then, by id. Ends only when ``wait`` raises.
    """
    records = OwnRecords(store, WRITER, CHANNELS)
    key = attrgetter("id", "revision", "state")
    known: Known = {}
    standing: Diagnosis | None = None
    for finding in symptoms_and_diagnoses(records.step()):
        if isinstance(finding, Diagnosis):
            standing = finding
        else:
            known[finding.id] = finding
    if standing is not None and standing.state == "open":
        yield standing, dict(known)
    while True:
        for finding in symptoms_and_diagnoses(records.step()):
            if not isinstance(finding, Diagnosis):
                known[finding.id] = finding
            elif standing is None or key(finding) != key(standing):  # files repeat it at first
                standing = finding
                yield finding, dict(known)
        wait(_POLL_S)


def text_of(
    engine: str, explanation: Explanation | None, ended_ns: int | None, nothing: str,
    folder: str = "FOLDER",
) -> str:  # fmt: skip
    """Return the explanation as text, or that nothing is wrong; a single engine is named on top.

    ``ended_ns`` is how long ago (ns) the last diagnosis ended, None for an open one. ``folder`` is
    the robot folder in commands.
    """
    alone = load_engine(engine)
    if explanation is None:
        text = (alone.NOTHING if alone is not None else "") or nothing
    else:
        text = as_text(explanation, folder=folder).rstrip("\n")
        if ended_ns is not None:
            ended = f"the last diagnosis ended {duration_text(ended_ns)} ago:"
            text = f"nothing is wrong now; {ended}\n\n{text}"
    return text if alone is None else f"{alone.ALONE}\n\n{text}"


def nothing_wrong(at_ns: int, states: Sequence[str], findings: Iterable[str]) -> str:
    """Return a text that no symptom is present, and how many are unknown."""
    unknown = states.count("unknown")
    rest = f"; {unknown} are not known" if unknown else ""
    count = f"{len(states)} symptom{'' if len(states) == 1 else 's'}"
    lines = [f"  found, and no failure mode explains it: {text}" for text in findings]
    at = format_time(at_ns)[:19]
    return "\n".join([f"nothing is wrong at {at}: of {count} none is there{rest}", *lines])


def revision_text(knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Known) -> str:
    """Return a revision as text, below a title line."""
    at = format_time(diagnosis.at_ns)[:23]
    title = f"== {at} {diagnosis.id}, revision {diagnosis.revision}"
    if diagnosis.state == "healed":
        return f"{title}: healed, nothing is wrong any more\n"
    return f"{title}\n\n{as_text(explain(diagnosis, knowledge, symptoms.values()))}"


def line_of(knowledge: Knowledge, diagnosis: Diagnosis, symptoms: Known) -> str:
    """Return a revision as one line of JSON."""
    case = DiagnosisContext(
        diagnosis.at_ns, ObservedSituation(tuple(symptoms.values())), diagnosis, "watcher"
    )
    explanation = explain(diagnosis, knowledge, symptoms.values())
    made = context_json(knowledge, case, diagnosis, explanation) | {"engine": COVERING}
    return json.dumps(made, ensure_ascii=False)


_WATCHER_LATE_NS = 10 * NS  # a watcher further behind its team's counts as silent


def with_members(
    knowledge: Knowledge, case: DiagnosisContext, explanation: Explanation | None
) -> Explanation | None:
    """Add to a team's explanation the diagnoses of the robots that it names, at that time.

    They are read from what the robots' watchers wrote; nothing is evaluated.
    """
    if explanation is None or explanation.broken is None:
        return explanation
    names = _robots_named(knowledge, (explanation.broken, *explanation.others))
    found = tuple(_member(name, knowledge.fmea.members[name], case.at_ns) for name in names)
    return replace(explanation, members=found)


def _robots_named(knowledge: Knowledge, groups: Sequence[ExplainedGroup]) -> list[str]:
    """Return the robots with probable faults, the most probable first."""
    worth = (g for g in groups if g.probability >= WORTH_SHOWING)
    faults = (f.id for g in worth for possible in g.members for f in possible.faults)
    robots = (fault.partition("#")[0].partition(":")[0] for fault in faults)
    return [name for name in dict.fromkeys(robots) if name in knowledge.fmea.members]


def _member(name: str, where: str, at_ns: int) -> MemberDiagnosis:
    try:
        return _member_diagnosis(name, where, at_ns)
    except (AmberboxError, OSError) as error:
        lines = str(error).splitlines() or [""]
        return _member_unknown(name, where, f"its folder cannot be read: {lines[0]}")


def _member_diagnosis(name: str, where: str, at_ns: int) -> MemberDiagnosis:
    """Return the diagnosis that a robot's watcher had written up to an instant of the
    same clock.
    """
    folder = load_folder(Path(where))
    plan, _ = load_plan(folder)
    knowledge, _ = load_knowledge(folder, plan)
    if knowledge is None:
        return _member_unknown(name, where, "it has no fmea.yaml that can be read")
    if not is_store(folder.store_path):
        return _member_unknown(name, where, f"{folder.store_path} is no store: nothing is recorded")
    store = open_store(folder.store_path)
    then_ns = min(at_ns, moment_ns(store))
    if at_ns - then_ns > _WATCHER_LATE_NS:
        since = f" since {date_and_clock(then_ns)}" if then_ns else ""
        return _member_unknown(name, where, f"its watcher has said nothing{since}")
    case = None
    if was_watched(store, knowledge.config_hash, then_ns):
        case = context_from_journal(knowledge, store, then_ns)
    if case is None:
        return _member_unknown(
            name, where, "nobody watched it then with the monitors that it has now"
        )
    return _member_summary(
        name, where, explain_context(knowledge, case, diagnose_context(knowledge, case)), then_ns
    )


def moment_ns(store: Store) -> int:
    """Return the time of the watcher's newest status (ns); 0 without one."""
    newest = newest_records(store, WRITER, {channels.STATUS}, 0.0)
    return max((record.values["measured_ns"] for record in newest), default=0)


def _member_summary(name: str, where: str, own: Explanation | None, at_ns: int) -> MemberDiagnosis:
    """Summarise a robot's own explanation."""
    if own is None or own.state == "healed":
        text = "nothing is wrong with it"
        before = "" if own is None else f". {own.headline.rstrip('.')}"
        state: MemberState = "none" if own is None else "healed"
        return MemberDiagnosis(name, where, state, sentence(f"{text}{before}"), at_ns)
    return MemberDiagnosis(
        name, where, "open", own.headline, own.at_ns, own.diagnosis, own.sure.probability,
        own.use.text, own.next.text,
    )  # fmt: skip


def _member_unknown(name: str, where: str, why: str) -> MemberDiagnosis:
    return MemberDiagnosis(name, where, "unknown", sentence(f"nothing is known of it: {why}"))


_SYMPTOM_STATES = ("present", "absent", "unknown")


def _run_on_server(args: argparse.Namespace) -> int:
    """Show a server's diagnosis; return 0 without a fault, 1 with one."""
    given = {"follow": args.follow, "folder": args.folder, "lookback": args.lookback != _LOOKBACK,
             "record": args.record, "who": args.who}  # fmt: skip
    refuse_options(args.where, given, "the server has the robot's folder, and looks itself; "
                   "amberbox status URL --watch shows what changes")  # fmt: skip
    check_time("--at", args.at)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.diagnose(
            robot, args.at, dict(map(_symptom_given, args.symptom)),
            dict(map(_answer_given, args.answer)), engine=args.engine, exposure_h=args.exposure,
        )  # fmt: skip
    answer = found.get("explanation")
    explanation = None if answer is None else msgspec.convert(answer, Explanation)
    print_notes(str(note) for note in found.get("notes", ()))
    if args.svg:
        _draw(args.svg, explanation)
    if args.json:
        print_json(found)
    elif args.svg != "-":
        print_lines([_server_text(args.engine, found, explanation)])
    return int(found["state"] == "open")


def _symptom_given(text: str) -> tuple[str, str]:
    name, _, state = text.partition("=")
    if state and state not in _SYMPTOM_STATES:
        raise UsageError(
            f"'{state}' is no state of a symptom", f"one of {', '.join(_SYMPTOM_STATES)}"
        )
    return name, state or "present"


def _answer_given(text: str) -> tuple[str, str]:
    test, equals, value = text.partition("=")
    if not (test and equals and value):
        raise UsageError(f"'{text}' is no answer", "write --answer TEST=VALUE")
    return test, value


def _server_text(engine: str, found: dict[str, Any], explanation: Explanation | None) -> str:
    at_ns = time_ns(found["at"])
    states = [symptom["state"] for symptom in found.get("symptoms", [])]
    ended_ns = None
    if explanation is not None and found["state"] == "healed":
        ended_ns = max(0, at_ns - explanation.at_ns)
    nothing = nothing_wrong(at_ns, states, found.get("findings", ()))
    return text_of(engine, explanation, ended_ns, nothing)
