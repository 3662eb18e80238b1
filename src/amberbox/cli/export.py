"""Data in and out: export a view of a record, import recordings, fetch windows from a robot."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import msgspec

from amberbox.blackbox.columns.variables import suggest_names
from amberbox.blackbox.formats._recording import ReadOptions
from amberbox.blackbox.query.export import FORMS, export
from amberbox.blackbox.query.export_job import ExportOptions, View
from amberbox.blackbox.query.importing import ImportReport, import_recordings
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.robot_folder.folder import store_of
from amberbox.cli._arguments import (
    PAGE,
    accept_relative_times,
    add_range,
    add_robot,
    add_where,
    add_window,
    missions_of,
    opened,
    refuse_options,
    remote_record,
    robot_at,
    windows,
)
from amberbox.cli._output import print_grid, print_json, print_notes, progress_bar, writable
from amberbox.client.address import is_url
from amberbox.client.remote import NOT_YET
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.safe_text import data_stream
from amberbox.core.source import TopicOptions
from amberbox.core.timestamps import format_time, parse_time
from amberbox.core.units import bytes_text

if TYPE_CHECKING:
    from amberbox.client.fleet import Fleet
    from amberbox.client.models import Download, Fetch, Time
    from amberbox.client.remote import RemoteRecord

JOURNALS = "journals"
_ENDINGS = {".csv": "csv", ".parquet": "parquet", ".mcap": "mcap", ".bag": "bag"}


def configure_export(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument(
        "-o", "--output", metavar="TARGET",
        help="file, or for csv and parquet a folder; CSV goes to stdout without",
    )  # fmt: skip
    parser.add_argument(
        "--format",
        choices=(*FORMS, JOURNALS),
        help="default: by the ending of TARGET; journals of servers only",
    )
    # Add the options that choose rows and columns.
    parser.add_argument(
        "--item", action="append", default=[], metavar="NAME",
        help="data item, again for more; all without",
    )  # fmt: skip
    parser.add_argument(
        "--variable", action="append", default=[], metavar="ITEM.VAR",
        help="only these variables of an item (csv, parquet, mcap-json)",
    )  # fmt: skip
    parser.add_argument(
        "--all-variables", action="store_true",
        help="also variables that black_box.yaml does not choose",
    )  # fmt: skip
    parser.add_argument("--received", action="store_true", help="add the columns received and seq")
    add_range(parser)
    add_window(parser)
    parser.add_argument(
        "--with-box", action="store_true",
        help="add what the box wrote about itself: events, gaps, clock",
    )  # fmt: skip
    parser.add_argument(
        "--raw-text", action="store_true",
        help="CSV: leave text as it is, also what a spreadsheet would calculate",
    )  # fmt: skip
    parser.add_argument(
        "--compression", choices=("none", "bz2", "lz4"), default="none",
        help="of the chunks of a ROS 1 bag",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run_export(args: argparse.Namespace) -> int:
    """Export and report; return 1 if something requested is missing."""
    target = None if args.output in (None, "-") else writable_target(args.output)
    form = chosen_form(args.format, target)
    if target is None and args.json:
        raise UsageError("the report and the rows would both go to stdout", "add -o TARGET")
    if is_url(args.where):
        with opened(args.where) as remote:
            variables = _variables(remote, args.variable)
        return _export_from_server(args, form, target, variables)
    if form == JOURNALS:
        raise UsageError("a store has its journals in it", f"copy {args.where}")
    options = ExportOptions(args.raw_text, args.compression)
    started = time.monotonic()
    with opened(args.where) as record:
        view = View(
            items=args.item,
            variables=_variables(record, args.variable),
            windows=windows(args, record),
            by=args.by,
            all_variables=args.all_variables,
            received=args.received,
            with_box=args.with_box,
        )
        progress = progress_bar(wanted=target is not None and not args.json)
        report = export(record, view, target, form, progress, options)
    if args.json:
        print_json(report.to_json())
    else:
        seconds = time.monotonic() - started
        output = sys.stdout if report.target else sys.stderr
        what = "messages" if report.form in ("mcap", "bag") else "rows"
        into = f", {bytes_text(report.bytes)} in {report.target}" if report.target else ""
        lines = report.lines() if report.target else [f"note: {text}" for text in report.notes]
        lines += [] if report.target else [f"missing: {text}" for text in report.missing]
        for line in [*lines, f"{report.total} {what} in {seconds:.1f} s{into}"]:
            print(line, file=output)
    return 1 if report.missing else 0


def writable_target(path: str) -> Path:
    """Return a target whose folder exists; raises UsageError when it cannot be written."""
    target = Path(path)
    return target if target.is_dir() else writable(path)


def chosen_form(named: str | None, target: Path | None) -> str:
    """Return the named format, else that of the target's suffix."""
    if named:
        return named
    if target is None:
        return "csv"
    form = _ENDINGS.get(target.suffix)
    if form is None:
        endings = ", ".join(_ENDINGS)
        raise UsageError(f"{target} does not say its format", f"add --format, or one of {endings}")
    return form


def _variables(record: Record, texts: Sequence[str]) -> dict[str, list[str]]:
    """Return ``ITEM.VAR`` texts grouped by item."""
    chosen: dict[str, list[str]] = {}
    known = [info.name for info in record.items()] if texts else []
    for text in texts:
        item = max((n for n in known if text.startswith(f"{n}.")), key=len, default=None)
        if item is None:
            raise UsageError(
                f"{text!r} is no ITEM.VAR", suggest_names(text.partition(".")[0], known)
            )
        chosen.setdefault(item, []).append(text[len(item) + 1 :])
    return chosen


_SERVER_FORMS = ("csv", "parquet", "mcap", JOURNALS)
_CONTENTS = "contents.json"

TimeSpan: TypeAlias = "tuple[Time, Time]"


def _export_from_server(
    args: argparse.Namespace, form: str, target: Path | None, variables: dict[str, list[str]]
) -> int:
    """Download an export made by the server; return 1 if part of the range is not there yet."""
    if form not in _SERVER_FORMS:
        raise UsageError(f"a server does not make {form}", "--format mcap, then amberbox export "
                         f"FILE.mcap --format {form}")  # fmt: skip
    with remote_record(args.where) as record:
        span = _server_span(record, args)
        if target is None:
            _print_csv(record, args, span, variables)
        else:
            made = _make_download(record, args, form, span, variables)
            files = _save_download(record, made, target)
            _print_files(made, files, as_json=args.json)
        return _refuse_incomplete(record, args, span)


def _server_span(record: RemoteRecord, args: argparse.Namespace) -> TimeSpan:
    if args.mission and (args.from_ or args.to or args.incident):
        raise UsageError("a mission has its own window", "leave out --from, --to and --incident")
    if not args.incident:
        return args.from_, args.to
    if args.from_ or args.to:
        raise UsageError("an incident has its own window", "leave out --from and --to")
    (window,) = record.incident_windows(args.incident)
    return window


def _print_csv(
    record: RemoteRecord, args: argparse.Namespace, span: TimeSpan, variables: dict[str, list[str]]
) -> None:
    """Write CSV to stdout, a page at a time."""
    refuse_options(args.where, {"with_box": args.with_box}, "add --item amberbox_event")
    if len(args.item) != 1:
        raise UsageError("stdout takes the rows of one item", "--item NAME, or -o FOLDER")
    (item,) = args.item
    spans = [span]
    if args.mission:
        spans = [(one.from_ns, one.to_ns) for one in missions_of(args, record) or ()]
    named = variables.get(item) or ([] if not args.all_variables else [
        column.name for column in record.variables(item).columns
    ])  # fmt: skip
    keys = ["received", "seq"] if args.received else []
    if keys and not named:
        named = record.query(item, None, None, None, points=1).names[1:]
    is_first, notes = True, dict[str, None]()
    for start, end in spans:
        pages = record.fleet.pages(record.robot, item, [*named, *keys] or None, start, end, args.by)
        for page in pages:
            page.table.to_csv(data_stream(sys.stdout), header=is_first, raw_text=args.raw_text)
            notes.update(dict.fromkeys(page.table.notes))
            is_first = False
    print_notes(notes)


def _make_download(
    record: RemoteRecord, args: argparse.Namespace, form: str, span: TimeSpan,
    variables: dict[str, list[str]],
) -> Download:  # fmt: skip
    """Start an export job on the server and wait for it."""
    given = {
        "by timestamp": args.by == "timestamp", "received": args.received,
        "all_variables": args.all_variables, "with_box": args.with_box,
        "raw_text": args.raw_text, "compression": args.compression != "none",
    }  # fmt: skip
    refuse_options(args.where, given, "without -o rows come to stdout, and all options count; or "
                   "--format mcap, then export that file")  # fmt: skip
    job = record.fleet.start_download(
        [record.robot], args.item, format=form, from_=span[0], to=span[1],
        missions=[args.mission] if args.mission else [], variables=variables,
    )  # fmt: skip
    bar = progress_bar(wanted=not args.json)
    try:
        return record.fleet.wait_download(job.id, bar)
    except KeyboardInterrupt:
        record.fleet.cancel_download(job.id)
        raise


def _save_download(record: RemoteRecord, made: Download, target: Path) -> list[Path]:
    """Save a download and return its files. A ZIP is unpacked into a folder."""
    is_folder = target.is_dir() or not target.suffix
    came = Path(made.file or "").suffix
    if not is_folder and came in (target.suffix, ""):
        return [record.fleet.save_download(made.id, target)]
    if is_folder:
        target.mkdir(exist_ok=True)
        if came != ".zip":
            return [record.fleet.save_download(made.id, target)]
    near = target if is_folder else target.parent
    with tempfile.TemporaryDirectory(prefix=".amberbox-", dir=near) as folder:
        packed = record.fleet.save_download(made.id, Path(folder) / "download.zip")
        return _unpack(packed, target, "" if is_folder else (*made.items, "")[0])


def _unpack(packed: Path, target: Path, item: str) -> list[Path]:
    """Unpack all files into a folder, or one item's file to the path ``target``."""
    with zipfile.ZipFile(packed) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
        if target.is_dir():
            return [Path(archive.extract(name, target)) for name in names]
        found = [name for name in names if name != _CONTENTS]
        own = [name for name in found if Path(name).stem == item]
        if len(own) == 1 < len(found):
            rest = sorted(Path(name).stem for name in found if name not in own)
            print_notes(
                [f"{name} is a table of its own: --item {name}, or a folder" for name in rest]
            )
            found = own
        if len(found) != 1:
            raise UsageError(f"these are {len(found)} files, not one",
                             "name a folder, a file ending in .zip, or one --item")  # fmt: skip
        with archive.open(found[0]) as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
        return [target]


def _print_files(made: Download, files: Sequence[Path], *, as_json: bool) -> None:
    print_notes(made.notes)
    size = sum(file.stat().st_size for file in files)
    if as_json:
        print_json({**msgspec.to_builtins(made), "files": [str(file) for file in files]})
        return
    for file in files:
        print(file)
    print(f"{len(files)} files, {bytes_text(size)}")


def _refuse_incomplete(record: RemoteRecord, args: argparse.Namespace, span: TimeSpan) -> int:
    """Return 0 if the server has the whole range, else raise AmberboxError with what is missing."""
    if args.mission:
        return 0
    gaps = [gap for gap in record.gaps(None, *span) if gap.reason == NOT_YET]
    if not gaps:
        return 0
    low, high = min(gap.from_ns for gap in gaps), max(gap.to_ns for gap in gaps)
    item = args.item[0] if len(args.item) == 1 else "all"
    window = f"{format_time(low)[:23]}Z {format_time(high)[:23]}Z"
    raise AmberboxError(
        f"not all of it is on the server yet: {len(gaps)} gaps between "
        f"{format_time(low)[:19]} and {format_time(high)[:19]}",
        f"amberbox fetch {args.where} {item} {window} --wait",
    )


def configure_import(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("inputs", nargs="+", type=Path, metavar="INPUT",
                        help="ROS bag, MCAP, ULog, CSV, CAN log, pcap, mongodump")  # fmt: skip
    parser.add_argument("--store", required=True, type=Path, metavar="DIR",
                        help="store or robot folder; made if it is not there")  # fmt: skip
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC",
                        help="import only these topics")  # fmt: skip
    parser.add_argument("--source", metavar="NAME",
                        help="first word of item names (default: as live)")  # fmt: skip
    parser.add_argument("--msg", type=Path, metavar="DIR",
                        help="folder of .msg files for the types of mongodump folders")  # fmt: skip
    parser.add_argument("--time", metavar="COLUMN", help="time column of CSV files")
    parser.add_argument("--start", metavar="TIME",
                        help="when files begin whose times are no dates")  # fmt: skip
    parser.add_argument("--dbc", nargs="+", type=Path, default=[], metavar="FILE",
                        help="DBC files that describe the messages of CAN logs")  # fmt: skip
    parser.add_argument("--eds", nargs="+", default=[], metavar="NODE=FILE",
                        help="EDS or DCF files of the CANopen nodes in CAN logs")  # fmt: skip
    parser.add_argument("--ethercat", type=Path, metavar="FILE",
                        help="black_box.yaml that describes captures of EtherCAT")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run_import(args: argparse.Namespace) -> int:
    """Import and report; return 1 if anything in the inputs was damaged."""
    started = time.monotonic()
    progress = progress_bar(wanted=not args.json)
    store = store_of(args.store) or args.store
    reports = import_recordings(
        args.inputs,
        store,
        topics=[TopicOptions(name) for name in args.topics],
        source=args.source,
        progress=progress,
        options=ReadOptions(
            args.msg, args.time, _start_ns(args.start), args.dbc, args.eds, args.ethercat
        ),
    )
    if args.json:
        print(json.dumps([_import_json(report) for report in reports], indent=2))
    else:
        print("\n".join(line for report in reports for line in report.lines()))
        total = sum(report.messages for report in reports)
        print(f"{total} messages in {time.monotonic() - started:.1f} s, now in {store}")
    return 1 if any(report.damage for report in reports) else 0


def _start_ns(text: str | None) -> int | None:
    return None if text is None else parse_time(text, time.time_ns, lambda: None)


def _import_json(report: ImportReport) -> dict[str, object]:
    return {
        "path": str(report.path),
        "messages": report.messages,
        "items": report.items,
        "kinds": report.kinds,
        "accounts": report.accounts,
        "notes": report.notes,
        "damage": report.damage,
        "already_imported": report.known,
    }


_ALL_ITEMS = "all"
_FETCH_POLL_S = 2.0
_FETCH_HEADER = ("id", "item", "from (UTC)", "to (UTC)", "state", "journals", "who")
_FETCH_USAGE = "amberbox fetch URL [ITEM FROM TO] [--wait] [--json]"


def configure_fetch(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    parser.usage = _FETCH_USAGE
    parser.add_argument("where", metavar="URL", help=PAGE)
    add_robot(parser)
    parser.add_argument(
        "window", nargs="*", metavar="ITEM FROM TO",
        help="data item ('all' for all), first time, end; without, what was asked is listed",
    )  # fmt: skip
    parser.add_argument("--wait", action="store_true", help="until all has come, or nothing can")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.epilog = "exit status: 0 asked, or come; 1 the robot has nothing of it any more"


def run_fetch(args: argparse.Namespace) -> int:
    """Request a window, or list the requested ones."""
    if not is_url(args.where):
        raise UsageError(f"{args.where} is no address of a server", f"{PAGE}")
    if len(args.window) not in (0, 3):
        raise UsageError("a window has an item, a beginning and an end", _FETCH_USAGE)
    fleet, robot = robot_at(args.where)
    with fleet:
        if not args.window:
            _print_fetches(fleet.fetches(robot)[::-1], as_json=args.json)
            return 0
        item, start, end = args.window
        asked = fleet.fetch(robot, "" if item == _ALL_ITEMS else item, start, end)
        if args.wait:
            asked = _wait_for_fetch(fleet, robot, asked)
    _print_fetches([asked], as_json=args.json)
    return int(asked.state in ("gone", "cancelled"))


def _wait_for_fetch(fleet: Fleet, robot: str, asked: Fetch) -> Fetch:
    """Wait until a fetch is over; Ctrl-C ends the waiting, not the request."""
    shown = ""
    while not asked.is_over:
        state = f"{asked.state}, {asked.copied} of {len(asked.journals)} journals"
        if state != shown:
            print_notes([state])
            shown = state
        time.sleep(_FETCH_POLL_S)
        asked = fleet.fetched(robot, asked.id)
    return asked


def _print_fetches(found: list[Fetch], *, as_json: bool) -> None:
    if as_json:
        print_json([msgspec.to_builtins(one) for one in found])
    elif found:
        print_grid(_FETCH_HEADER, map(_fetch_row, found))
        print_notes(f"{one.id}: {one.reason}" for one in found if one.reason)
    else:
        print("nothing was asked of this robot")


def _fetch_row(one: Fetch) -> tuple[str, ...]:
    journals = f"{one.copied} of {len(one.journals)}" if one.journals else "-"
    return one.id, one.item or _ALL_ITEMS, one.from_[:23], one.to[:23], one.state, journals, one.who
