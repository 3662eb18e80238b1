"""The worker's part of a download: make its files, put them into one, tell how far it is."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from amberbox.core.errors import UsageError
from amberbox.fleet.jobs.originals import write_journals, write_mcap
from amberbox.fleet.jobs.packing import pack
from amberbox.fleet.jobs.plan import Piece, pieces
from amberbox.fleet.jobs.tablefiles import write_tables
from amberbox.fleet.jobs.wanted import FOLDER, Wanted
from amberbox.fleet.jobs.workshop import Workshop

_WRITE: Mapping[str, Callable[[Workshop, Piece], Iterator[float]]] = {
    "csv": write_tables,
    "parquet": write_tables,
    "mcap": write_mcap,
    "journals": write_journals,
}
_MADE = 0.8
"""How much of the work is done when all files are there."""


def make(folder: Path, arguments: Mapping[str, Any]) -> Iterator[bytes]:
    """Make a download; gives its progress as JSON, in the end its file, size and notes.

    What was left of it before is thrown away. Raises UsageError when there is nothing in it.
    """
    path = folder / FOLDER / arguments["id"]
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True, mode=0o700)
    wanted = msgspec.convert(arguments["wanted"], Wanted)
    workshop = Workshop(folder, path, wanted, arguments["most_bytes"])
    chosen = list(pieces(folder, wanted, workshop.note))
    for number, piece in enumerate(chosen):
        for share in _WRITE[wanted.format](workshop, piece):
            yield _told(_MADE * (number + share) / len(chosen))
    if not workshop.entries:
        first = f": {workshop.notes[0]}" if workshop.notes else ""
        raise UsageError(f"there is nothing of this on the server{first}", "see the list of gaps")
    made: list[Path] = []
    for share in pack(workshop, arguments["asked_ns"], made):
        yield _told(_MADE + (1 - _MADE) * share)
    (file,) = made
    yield _told(1.0, file=file.name, bytes=file.stat().st_size, notes=workshop.notes[:100])


def _told(progress: float, **more: Any) -> bytes:
    return msgspec.json.encode({"progress": round(progress, 4), **more})
