"""What robots wrote themselves: journals as they are, or the messages in them as MCAP."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Row, select

from amberbox.blackbox.exporting import ExportReport, View, export
from amberbox.blackbox.follow.read import journal_file
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.store import create_store
from amberbox.core.errors import AmberboxError
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.data.look import open_catalogue
from amberbox.fleet.jobs.plan import Piece, safe
from amberbox.fleet.jobs.workshop import Entry, Workshop

_TELL_S = 0.5


def write_journals(workshop: Workshop, piece: Piece) -> Iterator[float]:
    """Count the journals of a piece among the files of the download; they are not copied."""
    items = {*workshop.wanted.items, *workshop.wanted.variables}
    for row, path in _journals(workshop, piece):
        if items and not items & set(journal_file(path, row.file).items):
            continue
        name = f"{safe(piece.robot)}/{row.store_id}/{row.file}"
        entry = Entry(name, path, row.sha256)
        if entry not in workshop.entries:
            workshop.entries.append(entry)
    workshop.check()
    yield 1.0


def write_mcap(workshop: Workshop, piece: Piece) -> Iterator[float]:
    """Write one MCAP file of each store of a robot; gives how much is done."""
    stores: dict[str, list[tuple[Row[Any], Path]]] = {}
    for row, path in _journals(workshop, piece):
        stores.setdefault(row.store_id, []).append((row, path))
    for number, (store_id, found) in enumerate(stores.items()):
        store = _store_of(workshop, store_id, found)
        suffix = f"-{store_id[:8]}" if len(stores) > 1 else ""
        target = workshop.place(piece.folder, f"{safe(piece.robot)}{suffix}.mcap")
        view = View(workshop.wanted.items, windows=((piece.from_ns, piece.to_ns),))
        yield from _exported(workshop, _Export(Record(store), view, target), number, len(stores))
        shutil.rmtree(store)


def _journals(workshop: Workshop, piece: Piece) -> Iterator[tuple[Row[Any], Path]]:
    """Give the journals that may hold rows of a piece; what is gone is noted."""
    chosen = select(JOURNALS).where(JOURNALS.c.robot == piece.robot)
    if piece.from_ns is not None:
        chosen = chosen.where(JOURNALS.c.end_ns >= piece.from_ns)
    if piece.to_ns is not None:
        chosen = chosen.where(JOURNALS.c.start_ns < piece.to_ns)
    with open_catalogue(workshop.server).database.reading() as connection:
        rows = connection.execute(chosen.order_by(JOURNALS.c.start_ns, JOURNALS.c.file)).all()
    layout = Layout(workshop.server)
    for row in rows:
        path = layout.journal(row.robot, row.store_id, row.file)
        if path.exists():
            yield row, path
        else:
            workshop.note(f"{row.robot}: the journal {row.file} is not kept any more")


def _store_of(workshop: Workshop, store_id: str, found: list[tuple[Row[Any], Path]]) -> Path:
    """Make a store of links to journals, which can be exported as on the robot."""
    store = workshop.path / f"store-{safe(store_id)}"
    create_store(store)
    for row, path in found:
        link = store / row.file
        link.parent.mkdir(parents=True, exist_ok=True)
        os.link(path, link)
    return store


@dataclass
class _Export(threading.Thread):
    """An export in a thread of its own, so that its progress can be told."""

    record: Record
    view: View
    target: Path
    done: float = 0.0
    report: ExportReport | None = None
    error: BaseException | None = None

    def __post_init__(self) -> None:
        threading.Thread.__init__(self, name="export", daemon=True)

    def __hash__(self) -> int:
        return id(self)

    def run(self) -> None:
        try:
            self.report = export(self.record, self.view, self.target, "mcap", self._tell)
        except BaseException as error:  # it is raised where it is waited for
            self.error = error

    def _tell(self, fraction: float) -> None:
        self.done = fraction


def _exported(workshop: Workshop, work: _Export, number: int, count: int) -> Iterator[float]:
    work.start()
    while work.is_alive():
        work.join(_TELL_S)
        yield (number + work.done) / count
        workshop.check(list(work.target.parent.glob(f"{work.target.name}*")))
    if isinstance(work.error, AmberboxError):  # nothing of it here; others may have some
        workshop.note(f"{work.target.stem}: {work.error.what}")
    elif work.error is not None:
        raise work.error
    elif work.report is not None:
        workshop.note(*(f"{work.target.stem}: {text}" for text in work.report.missing))
        workshop.add(work.target)
