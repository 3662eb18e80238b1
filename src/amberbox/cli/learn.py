"""Learn what is normal from nominal missions: a model file, and mode files with limits."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from amberbox.agent.commissioning.guard_files import guard_files
from amberbox.agent.commissioning.new_folder import write_files
from amberbox.blackbox.query.record import Record
from amberbox.cli._arguments import (
    PAGE,
    add_range_only,
    check_time,
    opened,
    robot_at,
    time_of,
)
from amberbox.cli._output import print_json, print_notes, progress_bar, writable
from amberbox.client.address import is_url, read_address
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_duration, ordered_span, parse_time
from amberbox.detection.learn import (
    DEFAULT_DETECTORS,
    learn,
    learnt_limits,
    read_options,
    report_lines,
)
from amberbox.detection.learnt_options import options_to_json
from amberbox.detection.missions import NominalRecord, missions_of_all
from amberbox.detection.model_file import detector_names, save_model


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "where", nargs="+", metavar="WHERE",
        help=f"robot folders, stores or recordings, or robots of a server: {PAGE}",
    )  # fmt: skip
    parser.add_argument(
        "--missions", nargs="+", default=[], metavar="NAME",
        help="names or ids of nominal missions; without: all that did not fail, else the record",
    )  # fmt: skip
    add_range_only(parser)
    parser.add_argument("-o", "--output", metavar="FILE", help="the model file to write")
    parser.add_argument(
        "--name", metavar="NAME",
        help="of a model on a server, where it becomes the next version of that name",
    )  # fmt: skip
    parser.add_argument(
        "--team", action="store_true",
        help="on a server: learn the robots side by side, as a team",
    )  # fmt: skip
    parser.add_argument(
        "--detectors", nargs="+", default=[], metavar="D",
        help=f"of {', '.join(detector_names())}; default: {' '.join(DEFAULT_DETECTORS)}, and those "
        "that --options names",
    )  # fmt: skip
    parser.add_argument(
        "--options", metavar="FILE", help="YAML file with options of detectors, by their names"
    )
    parser.add_argument(
        "--false-alarms", type=float, default=1.0, metavar="N",
        help="false alarms an hour of each detector to calibrate to (default: 1)",
    )  # fmt: skip
    parser.add_argument(
        "--monitors", metavar="FOLDER",
        help="robot folder to write components/ into, with the limits that were learnt",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one object")


def run(args: argparse.Namespace) -> int:
    """Learn, write, and print what can be promised."""
    remote = [where for where in args.where if is_url(where)]
    if remote:
        if len(remote) < len(args.where):
            raise UsageError("name robots of one server, or what is on this computer, not both")
        return _learn_on_server(args)
    _check_local(args)
    target = writable(args.output) if args.output else None
    options = read_options(Path(args.options)) if args.options else {}
    lines, files = [], {}
    with ExitStack() as stack:
        records = [stack.enter_context(opened(where)) for where in args.where]
        missions = missions_of_all(
            [
                NominalRecord(record, _name_of(where), record.missions())
                for where, record in zip(args.where, records, strict=True)
            ],
            args.missions,
            _span(args, records), lambda text: print_notes([text]),
        )  # fmt: skip
        lasted_ns = sum(end_ns - start_ns for start_ns, end_ns in (m.span for m in missions))
        how = f"from {format_duration(lasted_ns)} of {', '.join(m.name for m in missions[:5])}"
        if args.monitors:
            files = guard_files(learnt_limits(missions), how)
        if target is not None:
            detectors = args.detectors or [*DEFAULT_DETECTORS, *options]
            bar = progress_bar(wanted=not args.json)
            model = learn(missions, detectors, args.false_alarms, options, bar)
            save_model(model, target)
            lines = [*report_lines(model), f"wrote {target}"]
    if files:
        write_files(Path(args.monitors), files)
        lines.append(
            f"wrote {len(files)} files in {args.monitors}/components: look at them, "
            f"then amberbox check {args.monitors}"
        )
    if args.json:
        print_json({"learnt": how, "files": sorted(files), "report": lines})
        return 0
    print(f"learnt {how}")
    for line in lines:
        print(f"- {line}")
    return 0


def _check_local(args: argparse.Namespace) -> None:
    """Raise UsageError for options that make no sense together, or with no meaning here."""
    if args.name or args.team:
        raise UsageError("--name and --team are for models on a server", "name the file with -o")
    if not args.output and not args.monitors:
        raise UsageError("there is nothing to write", "name a file with -o, or --monitors FOLDER")
    if not (math.isfinite(args.false_alarms) and args.false_alarms > 0):
        raise UsageError("--false-alarms has to be a number above 0")


def _name_of(where: str) -> str:
    """Return what a record is called in the report: the robot folder, or the file."""
    return Path(where).resolve().name


def _span(args: argparse.Namespace, records: Sequence[Record]) -> tuple[int | None, int | None]:
    """Return ``--from`` and ``--to`` (ns); relative ones count from the last row of all records."""
    last_ns = max((ns for record in records if (ns := record.last_ns()) is not None), default=None)

    def read(text: str | None) -> int | None:
        return None if text is None else parse_time(text, time.time_ns, lambda: last_ns)

    return ordered_span(time_of("--from", args.from_, read), time_of("--to", args.to, read))


def _learn_on_server(args: argparse.Namespace) -> int:
    """Let a server learn from missions of its robots; save the model with ``-o``."""
    if args.monitors:
        raise UsageError(
            "a server does not write monitors", "amberbox learn FOLDER --monitors FOLDER"
        )
    addresses = [read_address(where) for where in args.where]
    if len({address.url for address in addresses}) > 1:
        raise UsageError("robots of several servers cannot be learnt from together")
    options = read_options(Path(args.options)) if args.options else {}
    for option in ("from_", "to"):
        check_time(f"--{option.strip('_')}", getattr(args, option))
    fleet, first = robot_at(args.where[0])
    with fleet:
        asked = fleet.learn(
            [first, *(address.robot or first for address in addresses[1:])], name=args.name or "",
            missions=args.missions, from_=args.from_, to=args.to,
            detectors=args.detectors, team=args.team,
            false_alarms_per_hour=args.false_alarms,
            options={name: options_to_json(one) for name, one in options.items()},
        )  # fmt: skip
        try:
            made = fleet.wait_model(asked.id, progress_bar(wanted=not args.json))
        except KeyboardInterrupt:
            fleet.delete_model(asked.id)
            raise
        lines = [*made.report]
        if args.output:
            lines.append(f"wrote {fleet.save_model(made.id, args.output)}")
    how = f"{made.name} version {made.version} on {fleet.url}"
    if args.json:
        print_json({"learnt": how, "id": made.id, "files": [], "report": lines})
        return 0
    print(f"learnt {how}")
    for line in lines:
        print(f"- {line}")
    return 0
