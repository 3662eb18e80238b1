"""The worker's part of a download: exports journals, MCAP, CSV or Parquet files into one file."""

from __future__ import annotations

import os
import re
import shutil
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from sqlalchemy import Row, select

from amberbox.blackbox.journal import channels
from amberbox.blackbox.query.export import export
from amberbox.blackbox.query.export_job import ExportReport, View
from amberbox.blackbox.query.record import LocalRecord, Record
from amberbox.blackbox.query.table import Table
from amberbox.blackbox.retention.missions import RecordedMission, missions_named
from amberbox.blackbox.store.journal_reader import journal_file
from amberbox.blackbox.store.store import create_store
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import below
from amberbox.core.timestamps import format_time
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.data.downloads import FOLDER, DownloadRequest
from amberbox.server.data.missions import missions
from amberbox.server.data.query import RowAnswer, RowQuery, arrow_table, rows
from amberbox.server.data.snapshot import RecordSnapshot, open_catalogue, with_snapshot
from amberbox.server.schema import JOURNALS
from amberbox.server.workers.protocol import LimitError

_FOREIGN = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True, slots=True)
class RecordRange:
    """A time range of one robot's record; ``folder`` is its folder in the download."""

    robot: str
    folder: str
    from_ns: int | None
    to_ns: int | None


def record_ranges(
    folder: Path, wanted: DownloadRequest, note: Callable[[str], None] = lambda text: None
) -> Iterator[RecordRange]:
    """Yield the time ranges of a download; raises UsageError for an unknown mission.

    Of several robots some may lack a mission, which is noted instead.
    """
    lacking: list[tuple[str, str, UsageError]] = []
    ids: set[str] = set()
    for robot in wanted.robots:
        if not wanted.missions:
            yield RecordRange(robot, safe_file_name(robot), wanted.from_ns, wanted.to_ns)
            continue
        known, found = missions(folder, robot), dict[str, RecordedMission]()
        for text in wanted.missions:
            try:
                found |= {mission.id: mission for mission in missions_named(known, text)}
            except UsageError as lack:
                lacking.append((robot, text, lack))
        for mission in found.values():
            ids.add(mission.id)
            place = f"{safe_file_name(robot)}/{safe_file_name(mission.id)}"
            yield RecordRange(robot, place, mission.from_ns, mission.to_ns)
    for robot, text, error in lacking:
        if not ids or len(wanted.robots) == 1:
            raise error
        if text not in ids:
            note(f"{robot}: {error.what}")


def safe_file_name(name: str) -> str:
    """Return a safe name for a file or folder, from any name that a robot uses."""
    return _FOREIGN.sub("_", name).lstrip(".")[:120] or "_"


def file_name(wanted: DownloadRequest, asked_ns: int, ending: str) -> str:
    """Return the file name of a download."""
    who = wanted.robots[0] if len(wanted.robots) == 1 else f"{len(wanted.robots)}-robots"
    moment = format_time(asked_ns)[:19].replace("-", "").replace(":", "")
    return f"{safe_file_name(who)}-{moment}-{wanted.format}{ending}"


_FREE_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class DownloadFile:
    """A file of a download: its name there, its path, and its SHA-256 if known."""

    name: str
    path: Path
    sha256: str = ""


@dataclass
class DownloadBuild:
    """The folder ``path`` of one download; ``server`` is the server's data folder."""

    server: Path
    path: Path
    wanted: DownloadRequest
    most_bytes: int
    entries: list[DownloadFile] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def place(self, folder: str, name: str) -> Path:
        """Return the path of a new file."""
        where = self.path / "files" / folder
        where.mkdir(parents=True, exist_ok=True)
        return below(where, name)

    def add(self, path: Path) -> None:
        """Add a finished file to the download."""
        self.entries.append(DownloadFile(str(path.relative_to(self.path / "files")), path))

    def note(self, *texts: str) -> None:
        """Add notes for the user, each once."""
        self.notes += [text for text in dict.fromkeys(texts) if text not in self.notes]

    def check(self, more: Sequence[Path] = ()) -> None:
        """Raise LimitError when the download is too large, or the disk nearly full."""
        size = sum(entry.path.stat().st_size for entry in self.entries)
        size += sum(path.stat().st_size for path in more if path.exists())
        if size > self.most_bytes:
            limit = f"{self.most_bytes / 1e9:g} GB"
            raise LimitError(f"the download would be larger than {limit}", "ask for less at a time")
        if shutil.disk_usage(self.path).free < _FREE_BYTES:
            raise LimitError("the server's disk is nearly full", "make room, then ask again")


_REPORT_S = 0.5


def write_journals(workshop: DownloadBuild, piece: RecordRange) -> Iterator[float]:
    """Add the journals of a range to the download without copying; yield the progress (0..1)."""
    items = {*workshop.wanted.items, *workshop.wanted.variables}
    for row, path in _journals(workshop, piece):
        if items and not items & set(journal_file(path, row.file).items):
            continue
        name = f"{safe_file_name(piece.robot)}/{row.store_id}/{row.file}"
        entry = DownloadFile(name, path, row.sha256)
        if entry not in workshop.entries:
            workshop.entries.append(entry)
    workshop.check()
    yield 1.0


def write_mcap(workshop: DownloadBuild, piece: RecordRange) -> Iterator[float]:
    """Write one MCAP file of each store of a robot; yield the progress (0..1)."""
    stores: dict[str, list[tuple[Row[Any], Path]]] = {}
    for row, path in _journals(workshop, piece):
        stores.setdefault(row.store_id, []).append((row, path))
    for number, (store_id, found) in enumerate(stores.items()):
        store = workshop.path / f"store-{safe_file_name(store_id)}"
        create_store(store)
        for row, path in found:  # links to journals can be exported as on the robot
            link = store / row.file
            link.parent.mkdir(parents=True, exist_ok=True)
            os.link(path, link)
        suffix = f"-{store_id[:8]}" if len(stores) > 1 else ""
        target = workshop.place(piece.folder, f"{safe_file_name(piece.robot)}{suffix}.mcap")
        view = View(workshop.wanted.items, windows=((piece.from_ns, piece.to_ns),))
        for share in _exported(workshop, LocalRecord(store), view, target):
            yield (number + share) / len(stores)
        shutil.rmtree(store)


def _journals(workshop: DownloadBuild, piece: RecordRange) -> Iterator[tuple[Row[Any], Path]]:
    """Yield the journals that may hold rows of a range; deleted ones are noted."""
    chosen = select(JOURNALS).where(JOURNALS.c.robot == piece.robot)
    if piece.from_ns is not None:
        chosen = chosen.where(JOURNALS.c.end_ns >= piece.from_ns)
    if piece.to_ns is not None:
        chosen = chosen.where(JOURNALS.c.start_ns < piece.to_ns)
    with open_catalogue(workshop.server).database.reading() as connection:
        rows = connection.execute(chosen.order_by(JOURNALS.c.start_ns, JOURNALS.c.file)).all()
    layout = ArchiveLayout(workshop.server)
    for row in rows:
        path = layout.journal(row.robot, row.store_id, row.file)
        if path.exists():
            yield row, path
        else:
            workshop.note(f"{row.robot}: the journal {row.file} is not kept any more")


def _exported(workshop: DownloadBuild, record: Record, view: View, target: Path) -> Iterator[float]:
    """Export in a separate thread, so that progress can be reported; yield the progress (0..1)."""
    done, outcome = deque([0.0], 1), list[ExportReport | BaseException]()

    def run() -> None:
        try:
            outcome.append(export(record, view, target, "mcap", done.append))
        except BaseException as error:  # raised in the waiting thread
            outcome.append(error)

    work = threading.Thread(target=run, name="export", daemon=True)
    work.start()
    while work.is_alive():
        work.join(_REPORT_S)
        yield done[0]
        workshop.check(list(target.parent.glob(f"{target.name}*")))
    (found,) = outcome
    if isinstance(found, AmberboxError):  # no data in this store; others may have some
        workshop.note(f"{target.stem}: {found.what}")
    elif isinstance(found, BaseException):
        raise found
    else:
        workshop.note(*(f"{target.stem}: {text}" for text in found.missing))
        workshop.add(target)


_STEP_ROWS = 200_000
_STEP_BYTES = 16 << 20
"""Compressed bytes of the section that is read at a time."""


_Writer = Callable[[Table], None]
_Task = tuple[str, list[str] | None, int]
"""One table of a piece, its variables, and how many of its rows to read at a time."""


def write_tables(workshop: DownloadBuild, piece: RecordRange) -> Iterator[float]:
    """Write the tables of a range; yield the progress (0..1)."""
    tasks = with_snapshot(workshop.server, piece.robot, lambda seen: _tasks(seen, workshop, piece))
    for number, task in enumerate(tasks):
        ending = f".{workshop.wanted.format}"
        path = workshop.place(piece.folder, f"{safe_file_name(task[0])}{ending}")
        for share in _write(workshop, piece, task, path):
            yield (number + share) / len(tasks)
        if path.exists():
            workshop.add(path)


def _tasks(seen: RecordSnapshot, workshop: DownloadBuild, piece: RecordRange) -> list[_Task]:
    wanted = workshop.wanted
    tables: dict[str, list[str] | None] = {}
    for name in [*dict.fromkeys([*wanted.items, *wanted.variables])]:
        try:
            schema = seen.schema(name)
        except UsageError as error:
            workshop.note(f"{piece.robot}: {error.what}")
            continue
        named = wanted.variables.get(name)
        tables[schema.item] = named
        if named is None:
            tables |= {t: None for t, v in seen.schemas.items() if v[-1].parent == schema.item}
    if not wanted.items and not wanted.variables:
        tables = {t: None for t, v in seen.schemas.items() if v[-1].source != channels.SOURCE}
    return [(table, names, _step(seen, table)) for table, names in sorted(tables.items())]


def _step(seen: RecordSnapshot, table: str) -> int:
    """Return how many rows to read at a time: few of images, many of numbers."""
    files = [
        file
        for source in seen.reader.sources
        for version in seen.reader.schemas.get(table, ())
        for file in seen.reader.files(source, version, None)
    ]
    size = sum(file.bytes for file in files) / max(sum(file.rows for file in files), 1)
    return int(min(max(_STEP_BYTES / max(size, 1), 1), _STEP_ROWS))


def _write(workshop: DownloadBuild, piece: RecordRange, task: _Task, path: Path) -> Iterator[float]:
    item, variables, step = task
    asked = RowQuery(piece.robot, item, variables, piece.from_ns, piece.to_ns, limit=step)
    answer = _read(workshop, asked)
    if not len(answer.table) and answer.about.next_ns is None:
        return
    names = [name for name in answer.table.names if name != "timestamp"]
    with _OPEN[workshop.wanted.format](path, answer.table) as write:
        while True:
            write(answer.table)
            workshop.note(*(f"{piece.robot}: {note}" for note in answer.about.notes))
            workshop.check([path])
            if answer.about.next_ns is None:
                return
            yield _share(piece, answer.about.next_ns)
            later_ns = answer.about.next_ns
            asked = RowQuery(piece.robot, item, names, later_ns, piece.to_ns, limit=step)
            answer = _read(workshop, asked)


def _read(workshop: DownloadBuild, asked: RowQuery) -> RowAnswer:
    return with_snapshot(workshop.server, asked.robot, lambda seen: rows(seen, asked))


def _share(piece: RecordRange, reached_ns: int) -> float:
    """Return the estimated progress (0..1) from the time reached; 0.5 without a range."""
    if piece.from_ns is None or piece.to_ns is None:
        return 0.5
    return min(max((reached_ns - piece.from_ns) / max(piece.to_ns - piece.from_ns, 1), 0.0), 1.0)


@contextmanager
def _open_csv(path: Path, like: Table) -> Iterator[_Writer]:
    with path.open("w", encoding="utf-8", newline="") as file:
        like.take(slice(0)).to_csv(file)
        yield lambda table: table.to_csv(file, header=False)


@contextmanager
def _open_parquet(path: Path, like: Table) -> Iterator[_Writer]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = arrow_table(like.take(slice(0))).schema
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:

        def write(table: Table) -> None:
            try:
                writer.write_table(arrow_table(table).cast(schema))
            except (pa.ArrowInvalid, ValueError) as error:
                what = f"the columns of {table.item} changed while they were being read"
                raise AmberboxError(what, "ask again") from error

        yield write


_OPEN: Mapping[str, Callable[[Path, Table], AbstractContextManager[_Writer]]] = {
    "csv": _open_csv,
    "parquet": _open_parquet,
}

FORMATS: Sequence[str] = tuple(_OPEN)
"""The formats that this worker makes."""


CONTENTS = "contents.json"

_COPY_BYTES = 1 << 20


def pack(workshop: DownloadBuild, asked_ns: int, made: list[Path]) -> Iterator[float]:
    """Pack the files of a download into one, whose path is appended to ``made``; yield progress."""
    entries = workshop.entries
    if len(entries) == 1:
        (entry,) = entries
        target = workshop.path / file_name(workshop.wanted, asked_ns, entry.path.suffix)
        os.link(entry.path, target)
    else:
        target = workshop.path / file_name(workshop.wanted, asked_ns, ".zip")
        yield from _zipped(workshop, asked_ns, target)
    with target.open("rb") as file:
        os.fsync(file.fileno())
    shutil.rmtree(workshop.path / "files", ignore_errors=True)
    made.append(target)


def _zipped(workshop: DownloadBuild, asked_ns: int, target: Path) -> Iterator[float]:
    total = sum(entry.path.stat().st_size for entry in workshop.entries) or 1
    done = 0
    with zipfile.ZipFile(target, "w", allowZip64=True, compresslevel=3) as file:
        file.writestr(CONTENTS, _contents(workshop, asked_ns))
        for entry in workshop.entries:
            info = zipfile.ZipInfo.from_file(entry.path, entry.name)
            is_text = entry.path.suffix in (".csv", ".json")
            info.compress_type = zipfile.ZIP_DEFLATED if is_text else zipfile.ZIP_STORED
            with entry.path.open("rb") as source, file.open(info, "w") as member:
                while piece := source.read(_COPY_BYTES):
                    member.write(piece)
                    done += len(piece)
                    yield done / total


def _contents(workshop: DownloadBuild, asked_ns: int) -> bytes:
    files = [
        {"name": entry.name, "bytes": entry.path.stat().st_size, "sha256": entry.sha256 or None}
        for entry in workshop.entries
    ]
    asked = msgspec.to_builtins(workshop.wanted)
    for name in ("from_ns", "to_ns"):
        moment = asked.pop(name)
        asked[name.removesuffix("_ns")] = None if moment is None else format_time(moment)
    contents = {"asked": asked, "asked_at": format_time(asked_ns), "files": files}
    return msgspec.json.format(msgspec.json.encode({**contents, "notes": workshop.notes}), indent=2)


_WRITE: Mapping[str, Callable[[DownloadBuild, RecordRange], Iterator[float]]] = {
    "csv": write_tables,
    "parquet": write_tables,
    "mcap": write_mcap,
    "journals": write_journals,
}
_MADE = 0.8
"""Share of the progress when all files are written."""


def make(folder: Path, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Make a download; yield its progress as JSON, at the end its file, size and notes.

    Remains of an earlier attempt are deleted. Raises UsageError when it would be empty.
    """
    path = folder / FOLDER / arguments["id"]
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True, mode=0o700)
    wanted = msgspec.convert(arguments["wanted"], DownloadRequest)
    workshop = DownloadBuild(folder, path, wanted, arguments["most_bytes"])
    chosen = list(record_ranges(folder, wanted, workshop.note))
    for number, piece in enumerate(chosen):
        for share in _WRITE[wanted.format](workshop, piece):
            yield progress_line(_MADE * (number + share) / len(chosen))
    if not workshop.entries:
        first = f": {workshop.notes[0]}" if workshop.notes else ""
        raise UsageError(f"there is nothing of this on the server{first}", "see the list of gaps")
    made: list[Path] = []
    for share in pack(workshop, arguments["asked_ns"], made):
        yield progress_line(_MADE + (1 - _MADE) * share)
    (file,) = made
    yield progress_line(1.0, file=file.name, bytes=file.stat().st_size, notes=workshop.notes[:100])


def progress_line(progress: float, **more: Any) -> bytes:
    return msgspec.json.encode({"progress": round(progress, 4), **more})
