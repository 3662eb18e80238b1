"""Watch a robot's record: monitor and diagnose it live, once, or over what is recorded."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import accept_relative_times, span_of, tell
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group

if TYPE_CHECKING:
    from amberbox.blackbox.folder.folder import RobotFolder
    from amberbox.blackbox.store import Store
    from amberbox.core.types import Status
    from amberbox.monitoring.engine.findings import Finding
    from amberbox.monitoring.plan import Plan
    from amberbox.monitoring.watcher.diagnosing import MakeDiagnoser
    from amberbox.monitoring.watcher.replay import Part

Say = Callable[["Finding"], None]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.add_argument("where", metavar="WHERE", help="robot folder, store or recording file")
    parser.add_argument("--folder", metavar="FOLDER", help="robot folder with the components, "
                        "where WHERE is none")  # fmt: skip
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--once", action="store_true", help="say how everything is at the end of "
                     "the record, and exit with 1 if anything is in error")  # fmt: skip
    how.add_argument("--replay", action="store_true", help="go over what is recorded")
    parser.add_argument("--speed", default="max", metavar="N", help="replay N times faster than "
                        "it was, or as fast as it goes (max)")  # fmt: skip
    times = "ISO (UTC), epoch, -10m before the last record, now or now-10m"
    parser.add_argument("--from", dest="from_", metavar="T", help=f"replay from here: {times}")
    parser.add_argument("--to", metavar="T", help="replay up to here")
    parser.add_argument("--json", action="store_true", help="every status, event and alarm as "
                        "one line of JSON")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="print nothing while watching")


def run(args: argparse.Namespace) -> int:
    """Watch as asked."""
    keep_to_group()
    if not args.replay and (args.from_ or args.to or args.speed != "max"):
        raise UsageError("--from, --to and --speed are about a replay", "add --replay")
    folder = _folder(args)
    plan = _plan(folder)
    diagnoser = _diagnoser(folder, plan)
    if args.replay:
        return _replay(args, plan, diagnoser)
    if args.once:
        return _once(args, plan, diagnoser)
    return _live(args, plan, folder, diagnoser)


def _folder(args: argparse.Namespace) -> RobotFolder:
    """Read the robot folder that says what is to be monitored."""
    from amberbox.blackbox.folder.folder import load_folder, store_of

    place = Path(args.folder or args.where)
    if args.folder is None and (not place.is_dir() or store_of(place) is None):
        raise UsageError(
            f"{place} says nothing about components",
            "name the robot folder, or add --folder FOLDER",
        )
    return load_folder(place)


def _plan(folder: RobotFolder) -> Plan:
    """Return what is to be monitored; errors of single parts are said, their statuses unknown."""
    from amberbox.monitoring.configuration import load_plan

    plan, problems = load_plan(folder)
    if not plan.components:
        raise UsageError(
            f"{folder.path} has no components", "write components/*.yaml, see docs/components.md"
        )
    errors = [problem for problem in problems if problem.is_error]
    if errors:
        tell([f"{len(errors)} errors in the component files: amberbox check {folder.path}"])
    return plan


def _diagnoser(folder: RobotFolder, plan: Plan) -> MakeDiagnoser | None:
    """Return what makes diagnoses by the folder's failure modes; with errors in them nothing."""
    from amberbox.consult.knowledge import diagnoser_of
    from amberbox.diagnosis.fmea.load import FILE

    make, problems = diagnoser_of(folder, plan)
    count = sum(problem.is_error for problem in problems)
    if count:
        errors = f"{count} error{'' if count == 1 else 's'} in {folder.path / FILE}"
        hint = f"amberbox fmea check {folder.path}"
        tell([f"{errors}: goes on without diagnosis; see {hint}"])
    return make


def _live(
    args: argparse.Namespace, plan: Plan, folder: RobotFolder, diagnoser: MakeDiagnoser | None
) -> int:
    from amberbox.blackbox.store import create_store
    from amberbox.monitoring.configuration.summary import in_words
    from amberbox.monitoring.watcher.watcher import Watch, Watcher

    if args.folder is not None and Path(args.where) != folder.path:
        raise UsageError("a store is watched by its robot folder", f"amberbox watch {args.folder}")
    say = _sayer(args)

    def hear(found: Sequence[Finding]) -> None:
        for finding in found:
            say(finding)

    store = create_store(folder.store_path)
    watcher = Watcher(Watch(plan, store, folder, diagnoser=diagnoser), hear)
    if not args.quiet and not args.json:
        print(f"watching {plan.robot}: {in_words(plan)}", flush=True)
    with _stoppable() as stop:
        watcher.run(stop)
    return 0


def _once(args: argparse.Namespace, plan: Plan, diagnoser: MakeDiagnoser | None) -> int:
    from amberbox.blackbox.store import is_locked
    from amberbox.cli._watchlines import shown
    from amberbox.monitoring.watcher.replay import newest

    with _record(args.where) as store:
        statuses, at_ns, diagnosis = newest(plan, store, diagnoser)
        if not is_locked(store, "main"):
            tell([f"nothing is being recorded; this is as of {shown(at_ns)}"])
    say = _sayer(args)
    for status in statuses:
        if args.json:
            say(status)
        elif not args.quiet:
            print(_status_line(status))
    if diagnosis is not None:
        say(diagnosis)
    return int(any(status.level == "error" for status in statuses))


def _replay(args: argparse.Namespace, plan: Plan, diagnoser: MakeDiagnoser | None) -> int:
    from amberbox.monitoring.watcher.replay import replay

    say = _sayer(args)
    with _record(args.where) as store, _stoppable() as stop:
        part = _part(args, store)
        if part.from_ns is not None and not args.json:
            _tell_lead(plan, diagnoser)
        for finding in replay(plan, store, part, stop, diagnoser):
            say(finding)
    return 0


def _tell_lead(plan: Plan, diagnoser: MakeDiagnoser | None) -> None:
    """Say why it takes a while until the first finding of a part comes."""
    from amberbox.monitoring.engine.engine import Engine
    from amberbox.monitoring.watcher.diagnosing import Diagnosing
    from amberbox.monitoring.watcher.replay import WARM_UP_S

    minutes = (WARM_UP_S + Diagnosing(Engine(plan), diagnoser and diagnoser()).history_s) / 60
    tell([f"monitors look back: begins {minutes:.0f} min before --from, if there is a record"])


@contextmanager
def _record(where: str) -> Iterator[Store]:
    """Open what is recorded: a store, or a recording that is imported for the moment."""
    from amberbox.blackbox.query.record import open as open_record
    from amberbox.blackbox.store import open_store

    with open_record(where) as record:
        tell(record.notes)
        yield open_store(record.path)


def _part(args: argparse.Namespace, store: Store) -> Part:
    from amberbox.blackbox.query.record import open as open_record
    from amberbox.monitoring.watcher.replay import Part

    record = open_record(store.path)
    return Part(*span_of(args, record), _speed(args.speed))


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0 < speed < float("inf"):
        raise UsageError(f"'{text}' is no speed", "write --speed 10, or max")
    return speed


def _sayer(args: argparse.Namespace) -> Say:
    """Return what prints a finding: as the journal has it, or for a person what has changed."""
    from amberbox.cli._watchlines import Lines
    from amberbox.monitoring.messages.records import encoded

    lines = Lines()

    def as_json(finding: Finding) -> None:
        _, data = encoded(finding)
        print(data.decode(), flush=True)

    def as_text(finding: Finding) -> None:
        line = lines.line(finding)
        if line is not None:
            print(line, flush=True)

    def silently(_: Finding) -> None:
        pass

    return silently if args.quiet else as_json if args.json else as_text


def _status_line(status: Status) -> str:
    name = f"  {status.component}/{status.mode}" if status.mode else status.component
    state = f" {status.state}" if status.state not in ("nominal", status.level) else ""
    return f"{status.level:<7} {name}{state}" + (f": {status.reason}" if status.reason else "")


@contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """Give an event that SIGTERM and SIGINT set."""
    stop = threading.Event()
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
