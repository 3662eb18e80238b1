"""Say what is broken: one ranked answer with reasons, and what to look at next."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import accept_relative_times, print_json, tell, text_output, time_of
from amberbox.cli._server import add_where
from amberbox.cli._text import print_lines
from amberbox.client.address import is_url
from amberbox.core.clock import NS
from amberbox.core.config import refuse
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time, parse_duration

if TYPE_CHECKING:
    from amberbox.blackbox.folder.folder import RobotFolder
    from amberbox.blackbox.query.record import Record
    from amberbox.consult.case import Case
    from amberbox.core.types import Diagnosis
    from amberbox.diagnosis.explanation import Explanation
    from amberbox.diagnosis.knowledge import Knowledge
    from amberbox.monitoring.plan import Plan

_USAGE = (
    "amberbox diagnose WHERE [--at T] [--symptom ID[=absent|unknown]]... [--answer TEST=VALUE]... "
    "[--engine covering|rules|faulttree] [--follow] [--json] [--svg FILE]"
)
RULES = "rules"
ENGINES = ("covering", RULES, "faulttree")
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
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0],
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
    """Show the diagnosis; 0 if nothing is wrong, 1 if something is."""
    _check(args)
    if is_url(args.where):
        from amberbox.cli._remote_diagnose import run_remote

        return run_remote(args, _LOOKBACK)
    folder = _folder(args)
    subject = _subject(args, folder)
    with _record(args.where) as record:
        if args.follow:
            return _follow(args, subject, record)
        case = _case(args, subject, record)
        case, diagnosis = _diagnosed(args, subject, case, record)
    return _show(args, subject, case, diagnosis)


@dataclass(frozen=True, slots=True)
class Subject:
    """The robot that it is about: its folder, its monitors, and what is known of its faults."""

    folder: RobotFolder
    plan: Plan
    knowledge: Knowledge


def _check(args: argparse.Namespace) -> None:
    if args.exposure is not None and not 0.0 <= args.exposure < math.inf:
        raise UsageError(f"an exposure of {args.exposure:g} h cannot be", "give hours from 0")
    if args.follow and (args.at or args.symptom or args.answer or args.svg):
        raise UsageError("--follow shows what the watcher finds", "leave out the other options")
    if args.json and args.svg == "-":
        raise UsageError("--json and --svg - both print", "--svg FILE")
    if parse_duration(args.lookback) <= 0:
        raise UsageError(f"--lookback {args.lookback} is too short", f"--lookback {_LOOKBACK}")


def _folder(args: argparse.Namespace) -> RobotFolder:
    """Read the robot folder that has the failure modes."""
    from amberbox.blackbox.folder.folder import load_folder, store_of

    place = Path(args.folder or args.where)
    if args.folder is None and place.exists() and store_of(place) is None:
        raise UsageError(
            f"{place} says nothing about failure modes",
            "name the robot folder, or add --folder FOLDER",
        )
    return load_folder(place)


def _subject(args: argparse.Namespace, folder: RobotFolder) -> Subject:
    from amberbox.consult.knowledge import knowledge_of
    from amberbox.monitoring.configuration import load_plan

    plan, problems = load_plan(folder)
    errors = [problem for problem in problems if problem.is_error]
    knowledge, found = knowledge_of(folder, plan, args.exposure)
    refuse([problem for problem in found if problem.is_error])
    if errors:
        tell([f"{len(errors)} errors in the component files: amberbox check {folder.path}"])
    if knowledge is None:
        raise UsageError(
            f"{folder.path} has no fmea.yaml: nobody has said what can fail on this robot",
            "write one, see docs/fmea.md; amberbox new FOLDER makes a folder with an example",
        )
    return Subject(folder, plan, knowledge)


@contextmanager
def _record(where: str) -> Iterator[Record | None]:
    """Open what is recorded; None for a robot folder that has no record."""
    from amberbox.blackbox.folder.folder import store_of
    from amberbox.blackbox.query.record import open as open_record
    from amberbox.blackbox.store import is_store

    store = store_of(Path(where))
    if store is not None and not is_store(store):
        yield None
        return
    with open_record(where) as record:
        tell(record.notes)
        yield record


def _case(args: argparse.Namespace, subject: Subject, record: Record | None) -> Case:
    """Read what was known, and add what somebody says."""
    from amberbox.consult.case import Case
    from amberbox.consult.given import given_answers, given_symptoms

    if record is None and (args.at is not None or not args.symptom):
        raise UsageError(
            f"there is no record in {args.where}, so nobody knows any symptom",
            "say what is seen: --symptom ID, or record something first",
        )
    case = Case(time.time_ns()) if record is None else _read(args, subject, record)
    symptoms = given_symptoms(args.symptom, subject.knowledge, case.at_ns)
    answers = given_answers(args.answer, subject.knowledge)
    return case.told(symptoms, answers) if symptoms or answers else case


def _read(args: argparse.Namespace, subject: Subject, record: Record) -> Case:
    """Read what was known at an instant: by the watcher's journal, else by evaluating."""
    from amberbox.blackbox.store import open_store
    from amberbox.consult.case import Case
    from amberbox.consult.journal import end_ns
    from amberbox.consult.reading import known_at

    store, knowledge = open_store(record.path), subject.knowledge
    at_ns = end_ns(store) if args.at is None else time_of("--at", args.at, record.time_ns)
    at_ns = record.last_ns() if at_ns is None else at_ns
    if at_ns is None:
        return Case(time.time_ns())  # a record without rows
    lookback_s = parse_duration(args.lookback) / NS
    case = known_at(knowledge, subject.plan, store, at_ns, lookback_s)
    if at_ns - case.at_ns > _LATE_NS:
        tell([f"nothing was recorded after {format_time(case.at_ns)[:19]}; this is as of then"])
    return case


def _follow(args: argparse.Namespace, subject: Subject, record: Record | None) -> int:
    """Print the diagnosis that stands, and each revision as it comes, until Ctrl-C."""
    from amberbox.blackbox.store import is_locked, open_store
    from amberbox.cli._diagnosis_follow import revisions
    from amberbox.cli._diagnosis_show import line_of, revision_text
    from amberbox.monitoring.messages.board import WRITER

    if record is None:
        raise UsageError(f"there is no record in {args.where} to follow", "record something first")
    store = open_store(record.path)
    if not is_locked(store, WRITER):
        tell([f"nobody watches, so nothing new will come: amberbox watch {subject.folder.path}"])
    show = line_of if args.json else revision_text
    for diagnosis, symptoms in revisions(store):
        print(show(subject.knowledge, diagnosis, symptoms), flush=True)
    return 0


def _diagnosed(
    args: argparse.Namespace, subject: Subject, case: Case, record: Record | None
) -> tuple[Case, Diagnosis | None]:
    """Let the engine answer; what rules find is known to all of them."""
    from amberbox.consult.engines import Ground, diagnosis_by, with_findings
    from amberbox.consult.span import Window

    if args.engine == RULES and args.answer:
        tell(["answers to tests count for nothing where the rules alone are asked"])
    lookback_ns = parse_duration(args.lookback)
    past = None if record is None else partial(Window, record)
    ground = Ground(subject.knowledge, subject.folder.path, past, lookback_ns)
    if args.engine != RULES:
        case = with_findings(ground, case)
    return case, diagnosis_by(args.engine, ground, case)


def _show(
    args: argparse.Namespace, subject: Subject, case: Case, diagnosis: Diagnosis | None
) -> int:
    from amberbox.cli._diagnosis_members import with_members
    from amberbox.cli._diagnosis_show import alone_text, text_of
    from amberbox.consult.case import is_wrong
    from amberbox.consult.telling import explained, json_of

    explanation = explained(subject.knowledge, case, diagnosis)
    explanation = with_members(subject.knowledge, case, explanation)
    if args.svg:
        _draw(args.svg, explanation)
    if args.json:
        made = json_of(subject.knowledge, case, diagnosis, explanation)
        print_json({**made, "engine": args.engine})
    elif args.svg != "-":
        text = text_of(case, diagnosis, explanation)
        if diagnosis is None and args.engine == RULES:
            text = "nothing follows from them"
        print_lines([alone_text(args.engine, text)])
    return int(is_wrong(case, diagnosis))


def _draw(path: str, explanation: Explanation | None) -> None:
    from amberbox.diagnosis.explanation import as_svg

    if explanation is None:
        tell(["there is no diagnosis, so nothing is drawn"])
        return
    with text_output(None if path == "-" else path) as file:
        file.write(as_svg(explanation))
