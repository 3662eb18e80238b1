"""Run the detectors of a model on a robot's record: live beside the watcher, or as a replay."""

from __future__ import annotations

import argparse
import json
import threading
from collections.abc import Sequence
from pathlib import Path

from amberbox.agent.detect import DetectProcess, changed_ns, read_for, replayed
from amberbox.blackbox.query.record import open as open_record
from amberbox.blackbox.robot_folder.folder import ROBOT_FILE, load_folder
from amberbox.blackbox.store.store import create_store, open_store
from amberbox.cli._arguments import accept_relative_times, span_of
from amberbox.cli._output import print_notes
from amberbox.core.errors import UsageError
from amberbox.core.files import keep_to_group
from amberbox.core.interrupt import called_by_signals
from amberbox.core.timestamps import format_duration
from amberbox.detection.alarms import DetectorAlarm, alarm_to_json
from amberbox.detection.record_detection import Detected
from amberbox.monitoring.finding_lines import shown


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.add_argument(
        "where", metavar="WHERE", help="robot folder; with --replay also a store or a recording"
    )
    parser.add_argument(
        "model", metavar="MODEL", nargs="?", default="",
        help="model file of amberbox learn; without, the one of detection: in robot.yaml",
    )  # fmt: skip
    parser.add_argument("--replay", action="store_true", help="go over what is recorded")
    times = "ISO (UTC), epoch, -10m before the last record, now or now-10m"
    parser.add_argument("--from", dest="from_", metavar="T", help=f"replay from here: {times}")
    parser.add_argument("--to", metavar="T", help="replay up to here")
    parser.add_argument("--json", action="store_true", help="every alarm as one line of JSON")
    parser.add_argument("--quiet", action="store_true", help="print nothing while detecting")
    parser.epilog = "exit status: 0 after an orderly end, also by SIGTERM or Ctrl-C"


def run(args: argparse.Namespace) -> int:
    """Detect live until SIGTERM or Ctrl-C, or as a replay."""
    keep_to_group()
    if not args.replay and (args.from_ or args.to):
        raise UsageError("--from and --to are about a replay", "add --replay")
    return _replay(args) if args.replay else _live(args)


def _live(args: argparse.Namespace) -> int:
    if not Path(args.where).is_dir():
        raise UsageError(f"'{args.where}' is no robot folder", "name one, or add --replay")
    folder = load_folder(args.where)

    def receive(found: Sequence[Detected]) -> None:
        for one in found:
            _print(args, one)

    store, model, stop = create_store(folder.store_path), _model(args), threading.Event()
    process = DetectProcess(folder, store, model, receive)
    with called_by_signals(stop.set):
        process.run(stop)
        while not stop.is_set():  # the model's file has changed
            process = DetectProcess(folder, store, model, receive)
            process.run(stop)
    return 0


def _replay(args: argparse.Namespace) -> int:
    stop = threading.Event()
    with open_record(args.where) as record, called_by_signals(stop.set):
        print_notes(record.notes)
        store = open_store(record.path)
        model = read_for(_model(args), store)
        alarms = 0
        for found in replayed(model, store, *span_of(args, record), stop):
            alarms += isinstance(found, DetectorAlarm)
            _print(args, found)
    if not (alarms or args.json or args.quiet):
        print("no alarm")
    return 0


def _model(args: argparse.Namespace) -> Path:
    """Return the model that is named, or that the robot folder names."""
    if args.model:
        return Path(args.model)
    place = Path(args.where)
    options = load_folder(place).robot.detection if (place / ROBOT_FILE).is_file() else None
    if options is None:
        raise UsageError(
            f"{place} names no model of detectors",
            "name one, or write detection: {model: FILE} into robot.yaml",
        )
    return options.file(place)


def _print(args: argparse.Namespace, found: Detected) -> None:
    if args.quiet or not isinstance(found, DetectorAlarm):
        return
    if args.json:
        print(json.dumps(alarm_to_json(found), ensure_ascii=False), flush=True)
    else:
        print(_line(found), flush=True)


def _line(alarm: DetectorAlarm) -> str:
    at = shown(changed_ns(alarm))
    if alarm.gone_ns is not None:
        return f"{at}  over     {alarm.id} after {format_duration(alarm.gone_ns - alarm.onset_ns)}"
    text = f": {alarm.reason.text}" if alarm.reason.text else ""
    return f"{at}  present  {alarm.id}{text}"
