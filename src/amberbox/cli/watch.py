"""Watch a robot's record: monitor its components live, once, or over what is recorded."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.cli._output import accept_relative_times, tell
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time

if TYPE_CHECKING:
    from amberbox.blackbox.folder.folder import RobotFolder
    from amberbox.blackbox.store import Store
    from amberbox.core.types import Status
    from amberbox.monitoring.engine.findings import AlarmChange, Finding, Transition
    from amberbox.monitoring.plan import Plan
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
    if not args.replay and (args.from_ or args.to or args.speed != "max"):
        raise UsageError("--from, --to and --speed are about a replay", "add --replay")
    folder = _folder(args)
    plan = _plan(folder)
    if args.replay:
        return _replay(args, plan)
    if args.once:
        return _once(args, plan)
    return _live(args, plan, folder)


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


def _live(args: argparse.Namespace, plan: Plan, folder: RobotFolder) -> int:
    from amberbox.blackbox.store import create_store
    from amberbox.monitoring.configuration.summary import in_words
    from amberbox.monitoring.watcher.watcher import Watch, Watcher

    if args.folder is not None and Path(args.where) != folder.path:
        raise UsageError("a store is watched by its robot folder", f"amberbox watch {args.folder}")
    say = _sayer(args)

    def hear(found: Sequence[Finding]) -> None:
        for finding in found:
            say(finding)

    watcher = Watcher(Watch(plan, create_store(folder.store_path), folder), hear)
    if not args.quiet and not args.json:
        print(f"watching {plan.robot}: {in_words(plan)}", flush=True)
    with _stoppable() as stop:
        watcher.run(stop)
    return 0


def _once(args: argparse.Namespace, plan: Plan) -> int:
    from amberbox.blackbox.store import is_locked
    from amberbox.monitoring.watcher.replay import newest

    with _record(args.where) as store:
        statuses, at_ns = newest(plan, store)
        if not is_locked(store, "main"):
            tell([f"nothing is being recorded; this is as of {_time(at_ns)}"])
    say = _sayer(args)
    for status in statuses:
        if args.json:
            say(status)
        elif not args.quiet:
            print(_status_line(status))
    return int(any(status.level == "error" for status in statuses))


def _replay(args: argparse.Namespace, plan: Plan) -> int:
    from amberbox.monitoring.watcher.replay import replay

    say = _sayer(args)
    with _record(args.where) as store, _stoppable() as stop:
        part = _part(args, store)
        if part.from_ns is not None and not args.json:
            _tell_lead(plan)
        for finding in replay(plan, store, part, stop):
            say(finding)
    return 0


def _tell_lead(plan: Plan) -> None:
    """Say why it takes a while until the first finding of a part comes."""
    from amberbox.monitoring.engine.engine import Engine
    from amberbox.monitoring.watcher.replay import WARM_UP_S

    minutes = (WARM_UP_S + Engine(plan).history_s) / 60
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
    return Part(record.time_ns(args.from_), record.time_ns(args.to), _speed(args.speed))


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
    from amberbox.monitoring.engine.findings import AlarmChange, Transition
    from amberbox.monitoring.messages.records import encoded

    def as_json(finding: Finding) -> None:
        _, data = encoded(finding)
        print(data.decode(), flush=True)

    told: set[tuple[int, str, str]] = set()

    def as_text(finding: Finding) -> None:
        if isinstance(finding, Transition | AlarmChange):
            print(_line(finding, told), flush=True)

    def silently(_: Finding) -> None:
        pass

    return silently if args.quiet else as_json if args.json else _with_silence(as_text)


def _with_silence(say: Say) -> Say:
    """Say once when the recorder has fallen silent, and once when it goes on."""
    from amberbox.core.types import Status

    silent = False

    def hear(finding: Finding) -> None:
        nonlocal silent
        if isinstance(finding, Status) and finding.live_only != silent:
            silent = finding.live_only
            text = f"everything is unknown: {finding.reason}" if silent else "the record goes on"
            print(f"{_time(finding.measured_ns)} {text}", flush=True)
        say(finding)

    return hear


def _line(finding: Transition | AlarmChange, told: set[tuple[int, str, str]]) -> str:
    """Write a finding; the reason of an instant is told once, by whom it concerns first."""
    from amberbox.monitoring.engine.findings import Transition

    if isinstance(finding, Transition):
        at_ns, text = finding.at_ns, finding.text.removesuffix(f": {finding.reason}")
        hint = f" (hint: {finding.hint})" if finding.hint else ""
    else:
        at_ns, hint = finding.changed_ns, ""
        times = f", {finding.count} times" if finding.count > 1 else ""
        text = f"{finding.component}: alarm {finding.id} {finding.state}"
        text += f" ({finding.severity}{times})" if finding.state != "healed" else ""
    said = (at_ns, finding.component, finding.reason)
    if not finding.reason or said in told or text.endswith("healed"):
        return f"{_time(at_ns)} {text}"
    if not any(entry[0] == at_ns for entry in told):
        told.clear()
    told.add(said)
    return f"{_time(at_ns)} {text}: {finding.reason}{hint}"


def _status_line(status: Status) -> str:
    name = f"  {status.component}/{status.mode}" if status.mode else status.component
    state = f" {status.state}" if status.state not in ("nominal", status.level) else ""
    return f"{status.level:<7} {name}{state}" + (f": {status.reason}" if status.reason else "")


def _time(at_ns: int) -> str:
    return format_time(at_ns)[:23]


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
