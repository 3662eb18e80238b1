"""What verbs share when they print: tables, JSON, files, time ranges."""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from amberbox.blackbox.query.fitting import Room
from amberbox.blackbox.query.tabletext import grid
from amberbox.cli._server import remote_record
from amberbox.client.address import is_url
from amberbox.core.errors import UsageError
from amberbox.core.files import open_to_all
from amberbox.core.terminal import for_data
from amberbox.core.timetext import in_order, parse_time
from amberbox.fleet.archive.where import archive_in

if TYPE_CHECKING:
    from amberbox.blackbox.query.record import Record


def print_json(value: Any) -> None:
    """Print a value as JSON for programs and people."""
    print(json.dumps(value, indent=2, ensure_ascii=False))


def print_grid(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table for the eye; in a terminal it gets no wider than that."""
    print(grid(header, list(rows), room=room(sys.stdout, "--json has all")))


def room(file: IO[str], more: str) -> Room | None:
    """Return how wide a table may be: what fits a terminal, anything in a file or a pipe.

    ``more`` says how to get the columns that there is no room for.
    """
    return Room(shutil.get_terminal_size().columns, more) if file.isatty() else None


def secret(question: str) -> str:
    """Take a secret where no shell remembers it and nobody sees it."""
    if sys.stdin.isatty():
        import getpass  # few verbs ask

        return getpass.getpass(question)
    return sys.stdin.readline().rstrip("\n")


def warn_readable(folder: Path) -> None:
    """Warn on stderr of a folder with data that everybody on this computer can read."""
    what = open_to_all(folder)
    if what:
        print(f"warning: {what}\nhint: chmod -R o-rwx {folder}", file=sys.stderr, flush=True)


def tell(notes: Iterable[str]) -> None:
    """Say on stderr what could not be read."""
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


@contextmanager
def opened(where: str) -> Iterator[Record]:
    """Open a record, a server's archive of many, or a robot's record on a server.

    Says what of it cannot be read.
    """
    from amberbox.blackbox.query.record import open as open_record

    if is_url(where):
        with remote_record(where) as remote:
            yield remote
        return
    archive = archive_in(where)
    with open_record(where) if archive is None else _opened_archive(*archive) as record:
        tell(record.notes)
        yield record


def _opened_archive(folder: Path, robots: Sequence[str]) -> Record:
    try:
        from amberbox.fleet.archive.record import open_archive
    except ImportError:
        what = f"{folder} is a server's archive: reading it needs what servers have installed"
        raise UsageError(what, "pip install 'amberbox[server]'") from None
    return open_archive(folder, robots)


@contextmanager
def text_output(path: str | None) -> Iterator[IO[str]]:
    """Open the file to write to, or stdout."""
    if path is None:
        yield for_data(sys.stdout)
        return
    with writable(path).open("w", encoding="utf-8", newline="") as file:
        yield file


def writable(path: str) -> Path:
    """Return a path whose folder exists.

    Raises UsageError when it cannot be written.
    """
    target = Path(path)
    folder = target.parent
    if not folder.is_dir():
        raise UsageError(f"cannot write {path}: there is no folder {folder}", "make it first")
    if target.is_dir() or not os.access(target if target.exists() else folder, os.W_OK):
        raise UsageError(f"cannot write {path}", "choose a file in a folder that can be written")
    return target


def accept_relative_times(parser: argparse.ArgumentParser) -> None:
    """Let ``--from -10m`` stand as a value: argparse would take it for an option."""
    parser._negative_number_matcher = re.compile(r"-\d")


def add_range_only(parser: argparse.ArgumentParser) -> None:
    """Add ``--from`` and ``--to``."""
    accept_relative_times(parser)
    times = "ISO (UTC), epoch, -10m before the last record, now or now-10m"
    parser.add_argument("--from", dest="from_", metavar="T", help=f"first time: {times}")
    parser.add_argument("--to", metavar="T", help="end of the range, not included")


def span_of(args: argparse.Namespace, record: Record) -> tuple[int | None, int | None]:
    """Return ``--from`` and ``--to``; raises UsageError if they cannot be, naming the option."""
    return in_order(
        time_of("--from", args.from_, record.time_ns), time_of("--to", args.to, record.time_ns)
    )


def time_of(option: str, text: str | None, read: Callable[[str | None], int | None]) -> int | None:
    """Read the time that an option gives; raises UsageError that names the option."""
    try:
        return read(text)
    except UsageError as error:
        raise UsageError(f"{option}: {error.what}", error.hint) from error


def check_time(option: str, text: str | None) -> None:
    """Raise UsageError, naming the option, for a time that a server could not read either."""
    if text:
        time_of(option, text, lambda said: parse_time(said or "", time.time_ns, lambda: 0))


def add_range(parser: argparse.ArgumentParser) -> None:
    """Add ``--from``, ``--to`` and ``--by``."""
    add_range_only(parser)
    parser.add_argument(
        "--by", choices=("received", "timestamp"), default="received",
        help="go by time of receipt (default) or by the item's own stamps",
    )  # fmt: skip
