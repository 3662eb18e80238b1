"""Watch a robot's record: monitor and diagnose it live, once, or over what is recorded."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._arguments import accept_relative_times, span_of
from amberbox.cli._output import print_notes
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group
from amberbox.core.interrupt import called_by_signals
from amberbox.core.types import Status
from amberbox.monitoring.finding_lines import FindingLines, shown
from amberbox.monitoring.findings import Finding

if TYPE_CHECKING:
    from amberbox.blackbox.robot_folder.folder import RobotFolder
    from amberbox.blackbox.store.store import Store
    from amberbox.monitoring.plan import MonitoringPlan
    from amberbox.monitoring.record_evaluation import MakeDiagnoser, ReplayOptions


EmitFinding = Callable[["Finding"], None]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.add_argument("where", metavar="WHERE", nargs="?", default="", help="robot folder, "
                        "store or recording file; with --auto also ros or ros2, also with "
                        "=ADDRESS")  # fmt: skip
    parser.add_argument("--folder", metavar="FOLDER", help="robot folder with the components, "
                        "where WHERE is none")  # fmt: skip
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--once", action="store_true", help="say how everything is at the end of "
                     "the record, and exit with 1 if anything is in error")  # fmt: skip
    how.add_argument("--replay", action="store_true", help="go over what is recorded")
    how.add_argument("--auto", action="store_true", help="record and watch a running robot at "
                     "once, by what is learned of it in the first seconds [ros]")  # fmt: skip
    parser.add_argument("--listen", type=float, metavar="SECONDS", help="with --auto, how long to "
                        "learn [20]")  # fmt: skip
    parser.add_argument("--keep", metavar="DIR", help="with --auto, keep the robot folder that is "
                        "made, and its record, here")  # fmt: skip
    parser.add_argument("--speed", default="max", metavar="N", help="replay N times faster than "
                        "it was, or as fast as it goes (max)")  # fmt: skip
    times = "ISO (UTC), epoch, -10m before the last record, now or now-10m"
    parser.add_argument("--from", dest="from_", metavar="T", help=f"replay from here: {times}")
    parser.add_argument("--to", metavar="T", help="replay up to here")
    parser.add_argument("--json", action="store_true", help="every status, event and alarm as "
                        "one line of JSON")  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="print nothing while watching")


def run(args: argparse.Namespace) -> int:
    """Run the watcher live, once, or as a replay."""
    keep_to_group()
    if args.auto:
        from amberbox.cli._auto import run_auto

        return run_auto(args)
    if args.listen is not None or args.keep is not None:
        raise UsageError("--listen and --keep are about what --auto learns", "add --auto")
    if not args.where:
        raise UsageError("WHERE is missing", "name a robot folder, or watch --auto ros")
    if not args.replay and (args.from_ or args.to or args.speed != "max"):
        raise UsageError("--from, --to and --speed are about a replay", "add --replay")
    folder = _folder(args)
    plan = _plan(folder)
    if args.replay:
        return _replay(args, plan, folder)
    if args.once:
        return _once(args, plan, folder)
    return _live(args, plan, folder)


def _folder(args: argparse.Namespace) -> RobotFolder:
    """Load the robot folder with the components."""
    from amberbox.blackbox.robot_folder.folder import load_folder, store_of

    place = Path(args.folder or args.where)
    if args.folder is None and (not place.is_dir() or store_of(place) is None):
        raise UsageError(
            f"{place} says nothing about components",
            "name the robot folder, or add --folder FOLDER",
        )
    return load_folder(place)


def _plan(folder: RobotFolder) -> MonitoringPlan:
    """Load the monitoring plan; parts with errors are noted, their statuses are unknown."""
    from amberbox.monitoring.plan_loader import load_plan

    plan, problems = load_plan(folder)
    if not plan.components:
        raise UsageError(
            f"{folder.path} has no components",
            "write components/*.yaml, see docs/robot/components.md",
        )
    errors = [problem for problem in problems if problem.is_error]
    if errors:
        print_notes([f"{len(errors)} errors in the component files: amberbox check {folder.path}"])
    return plan


def _diagnoser(folder: RobotFolder, plan: MonitoringPlan, store: Store) -> MakeDiagnoser | None:
    """Return the factory of diagnosers from the folder's failure modes; None on errors."""
    from amberbox.consult.context import load_diagnoser
    from amberbox.diagnosis.fmea.loader import FILE

    make, problems = load_diagnoser(folder, plan, store.path)
    count = sum(problem.is_error for problem in problems)
    if count:
        errors = f"{count} error{'' if count == 1 else 's'} in {folder.path / FILE}"
        hint = f"amberbox fmea check {folder.path}"
        print_notes([f"{errors}: goes on without diagnosis; see {hint}"])
    return make


def _live(args: argparse.Namespace, plan: MonitoringPlan, folder: RobotFolder) -> int:
    from amberbox.blackbox.store.store import create_store
    from amberbox.monitoring.plan import plan_text
    from amberbox.monitoring.watcher import RecordWatcher, WatcherSetup

    if args.folder is not None and Path(args.where) != folder.path:
        raise UsageError("a store is watched by its robot folder", f"amberbox watch {args.folder}")
    emit = _printer(args)

    def receive(found: Sequence[Finding]) -> None:
        for finding in found:
            emit(finding)

    store = create_store(folder.store_path)
    diagnoser = _diagnoser(folder, plan, store)
    watcher = RecordWatcher(WatcherSetup(plan, store, folder, diagnoser=diagnoser), receive)
    if not args.quiet and not args.json:
        print(f"watching {plan.robot}: {plan_text(plan)}", flush=True)
    stop = threading.Event()
    with called_by_signals(stop.set):
        watcher.run(stop)
    return 0


def _once(args: argparse.Namespace, plan: MonitoringPlan, folder: RobotFolder) -> int:
    from amberbox.blackbox.store.store import is_locked
    from amberbox.monitoring.record_evaluation import end_of_record

    with _record(args.where) as store:
        diagnoser = _diagnoser(folder, plan, store)
        statuses, at_ns, diagnosis = end_of_record(plan, store, diagnoser)
        if not is_locked(store, "main"):
            print_notes([f"nothing is being recorded; this is as of {shown(at_ns)}"])
    emit = _printer(args)
    for status in statuses:
        if args.json:
            emit(status)
        elif not args.quiet:
            print(_status_line(status))
    if diagnosis is not None:
        emit(diagnosis)
    return int(any(status.level == "error" for status in statuses))


def _replay(args: argparse.Namespace, plan: MonitoringPlan, folder: RobotFolder) -> int:
    from amberbox.monitoring.record_evaluation import replay

    emit = _printer(args)
    stop = threading.Event()
    with _record(args.where) as store, called_by_signals(stop.set):
        diagnoser = _diagnoser(folder, plan, store)
        part = _part(args, store)
        if part.from_ns is not None and not args.json:
            _log_lead(plan, diagnoser)
        for finding in replay(plan, store, part, stop, diagnoser):
            emit(finding)
    return 0


def _log_lead(plan: MonitoringPlan, diagnoser: MakeDiagnoser | None) -> None:
    """Print how far before its range a replay begins."""
    from amberbox.monitoring.engine import Engine
    from amberbox.monitoring.record_evaluation import WARM_UP_S, DiagnosedEngine

    minutes = (WARM_UP_S + DiagnosedEngine(Engine(plan), diagnoser and diagnoser()).history_s) / 60
    print_notes(
        [f"monitors look back: begins {minutes:.0f} min before --from, if there is a record"]
    )


@contextmanager
def _record(where: str) -> Iterator[Store]:
    """Open a store, or a recording that is imported temporarily."""
    from amberbox.blackbox.query.record import open as open_record
    from amberbox.blackbox.store.store import open_store

    with open_record(where) as record:
        print_notes(record.notes)
        yield open_store(record.path)


def _part(args: argparse.Namespace, store: Store) -> ReplayOptions:
    from amberbox.blackbox.query.record import open as open_record
    from amberbox.monitoring.record_evaluation import ReplayOptions

    record = open_record(store.path)
    return ReplayOptions(*span_of(args, record), _speed(args.speed))


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


def _printer(args: argparse.Namespace) -> EmitFinding:
    """Return the printer of findings: JSON as in the journal, or text about changes."""
    from amberbox.monitoring.findings import encoded

    lines = FindingLines()

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
