"""``amberbox export`` of a robot on a server: rows to stdout, files made by the server."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import msgspec

from amberbox.cli._output import print_json, tell
from amberbox.cli._progress import progress_bar
from amberbox.cli._server import refuse_options, remote_record
from amberbox.client.data_models import Download
from amberbox.client.remote import NOT_YET, RemoteRecord
from amberbox.client.times import Time
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.terminal import for_data
from amberbox.core.timetext import format_time
from amberbox.core.units import in_bytes

FORMS = ("csv", "parquet", "mcap", "journals")
_CONTENTS = "contents.json"

Span = tuple[Time, Time]


def export_remote(
    args: argparse.Namespace, form: str, target: Path | None, variables: dict[str, list[str]]
) -> int:
    """Download what is asked for; 1 if some of it is not on the server yet."""
    if form not in FORMS:
        raise UsageError(f"a server does not make {form}", "--format mcap, then amberbox export "
                         f"FILE.mcap --format {form}")  # fmt: skip
    with remote_record(args.where) as record:
        span = _span(record, args)
        if target is None:
            _stream(record, args, span, variables)
        else:
            made = _made(record, args, form, span, variables)
            files = _placed(record, made, target, form)
            _tell(made, files, as_json=args.json)
        return _missing(record, args, span)


def _span(record: RemoteRecord, args: argparse.Namespace) -> Span:
    if args.mission and (args.from_ or args.to or args.incident):
        raise UsageError("a mission has its own window", "leave out --from, --to and --incident")
    if not args.incident:
        return args.from_, args.to
    if args.from_ or args.to:
        raise UsageError("an incident has its own window", "leave out --from and --to")
    (window,) = record.incident_windows(args.incident)
    return window


def _stream(
    record: RemoteRecord, args: argparse.Namespace, span: Span, variables: dict[str, list[str]]
) -> None:
    """Write CSV to stdout, a page at a time."""
    refuse_options(args.where, {"with_box": args.with_box}, "add --item amberbox_event")
    if len(args.item) != 1:
        raise UsageError("stdout takes the rows of one item", "--item NAME, or -o FOLDER")
    (item,) = args.item
    spans = [span]
    if args.mission:
        from amberbox.cli._missions import missions_of

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
            page.table.to_csv(for_data(sys.stdout), header=is_first, raw_text=args.raw_text)
            notes.update(dict.fromkeys(page.table.notes))
            is_first = False
    tell(notes)


def _made(
    record: RemoteRecord, args: argparse.Namespace, form: str, span: Span,
    variables: dict[str, list[str]],
) -> Download:  # fmt: skip
    """Let the server make the file, and wait for it."""
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


def _placed(record: RemoteRecord, made: Download, target: Path, form: str) -> list[Path]:
    """Save the file; return what is there afterwards. A ZIP is unpacked into a folder."""
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
        return _unpacked(packed, target, "" if is_folder else (*made.items, "")[0])


def _unpacked(packed: Path, target: Path, item: str) -> list[Path]:
    """Unpack all into a folder, or one item's file to a name of its own."""
    with zipfile.ZipFile(packed) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
        if target.is_dir():
            return [Path(archive.extract(name, target)) for name in names]
        found = [name for name in names if name != _CONTENTS]
        own = [name for name in found if Path(name).stem == item]
        if len(own) == 1 < len(found):
            rest = sorted(Path(name).stem for name in found if name not in own)
            tell([f"{name} is a table of its own: --item {name}, or a folder" for name in rest])
            found = own
        if len(found) != 1:
            raise UsageError(f"these are {len(found)} files, not one",
                             "name a folder, a file ending in .zip, or one --item")  # fmt: skip
        with archive.open(found[0]) as source, target.open("wb") as file:
            shutil.copyfileobj(source, file)
        return [target]


def _tell(made: Download, files: Sequence[Path], *, as_json: bool) -> None:
    tell(made.notes)
    size = sum(file.stat().st_size for file in files)
    if as_json:
        print_json({**msgspec.to_builtins(made), "files": [str(file) for file in files]})
        return
    for file in files:
        print(file)
    print(f"{len(files)} files, {in_bytes(size)}")


def _missing(record: RemoteRecord, args: argparse.Namespace, span: Span) -> int:
    """Say what of the range is still on the robot, and how to get it."""
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
