"""Listings of a robot's journals: their time range, their integrity, and gaps with reasons."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Row,
    Select,
    Table,
    and_,
    case,
    exists,
    or_,
    select,
    true,
)

from amberbox.blackbox.store.store import FOLDERS, run_and_number
from amberbox.core.api import GapKind, Integrity, RecordingState
from amberbox.core.timestamps import format_time
from amberbox.core.types import Gap
from amberbox.server.archive.catalogue import COMMITTED, REFUSED, RobotStore, in_archive
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.gaps import REFUSED as REFUSED_GAP
from amberbox.server.archive.gaps import TO_COME, WAITING, RefusedFile, gaps_of
from amberbox.server.archive.reader import Span
from amberbox.server.data.query import RowQuery
from amberbox.server.data.snapshot import RecordSnapshot
from amberbox.server.journals import decode
from amberbox.server.schema import JOURNALS, UPLOAD


@dataclass(frozen=True, slots=True)
class JournalListing:
    """A journal on the server, or on its way to it; times are those of receipt on the robot.

    They are None where unknown: while it is copied, and for most damaged ones.

    ``integrity``: ``unsigned`` is a valid journal after the last head that the robot signed;
    ``deleted`` one that retention deleted. It is judged by size only: ``altered`` may also be the
    result of a check of its content.
    """

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: RecordingState
    integrity: Integrity
    reason: str
    bytes: int
    copied: int
    rows: int
    from_ns: int | None
    to_ns: int | None
    came_ns: int | None


def recordings(
    connection: Connection, folder: Path, robot: str, after: str = "", limit: int = 100,
    span: Span = (None, None),
) -> list[JournalListing]:  # fmt: skip
    """Return journals by name (``store/folder/file``), those after a name.

    With a span: those that overlap it, and those of unknown range that arrived after its start.
    Only the files of listed journals are read from the disk.
    """
    held = {_name(row.store_id, row.file): row for row in connection.execute(_held(robot, span))}
    coming = {
        _name(row.store_id, row.journal): row for row in connection.execute(_not_held(robot, span))
    }
    names = sorted(name for name in (*held, *coming) if name > after)[:limit]
    base = ArchiveLayout(folder).journals / robot
    return [
        _of_archive(held[name], f"{base}/{name}") if name in held else _coming(coming[name], folder)
        for name in names
    ]


def _name(store_id: str, journal: str) -> str:
    return f"{store_id}/{journal}"


def _held(robot: str, span: Span) -> Select[Any]:
    """Select the journals of the archive; ``why`` is set only where one was refused."""
    j, u = JOURNALS.c, UPLOAD.c
    signed = exists().where(
        u.robot == j.robot, u.store_id == j.store_id, u.journal == j.file, u.signed.is_(True)
    )
    return select(
        j.store_id, j.file, j.keeping, j.sha256, j.state, j.bytes, j.rows, j.raw_gone, j.start_ns,
        j.end_ns, j.put_ns, case((j.state == REFUSED, j.facts), else_="").label("why"),
        signed.label("signed"),
    ).where(j.robot == robot, *_meets(JOURNALS, span))  # fmt: skip


def _not_held(robot: str, span: Span) -> Select[Any]:
    """Select the journals that are not in the archive: incoming, set aside, or quarantined."""
    u = UPLOAD.c
    meets = and_(true(), *_meets(UPLOAD, span))
    late = or_(u.ended_ns.is_(None), u.ended_ns >= (span[0] or 0))
    unknown = and_(u.end_ns == 0, late)
    return select(UPLOAD).where(u.robot == robot, ~in_archive(), or_(unknown, meets))


def _times(row: Row[Any]) -> tuple[int | None, int | None]:
    """Return from and to (ns); None for a file whose times are unknown (stored as zeros)."""
    return (row.start_ns, row.end_ns) if row.end_ns else (None, None)


def _meets(table: Table, span: Span) -> list[ColumnElement[bool]]:
    from_ns, to_ns = span
    found = [] if from_ns is None else [table.c.end_ns >= from_ns]
    return found + ([] if to_ns is None else [table.c.start_ns < to_ns])


def _of_archive(row: Row[Any], path: str) -> JournalListing:
    states: dict[str, RecordingState] = {COMMITTED: "in_columns", REFUSED: "refused"}
    return JournalListing(
        row.store_id, row.file, row.keeping, row.sha256, states.get(row.state, "waiting"),
        _integrity(row, path), decode(row.why).refused if row.why else "", row.bytes, row.bytes,
        row.rows, *_times(row), row.put_ns,
    )  # fmt: skip


def _integrity(row: Row[Any], path: str) -> Integrity:
    if row.raw_gone:
        return "deleted"
    try:
        size = os.stat(path).st_size  # noqa: PTH116  # thousands at a time
    except FileNotFoundError:
        return "missing"
    was_changed = row.state == REFUSED and not decode(row.why).by
    if was_changed or size != row.bytes:
        return "altered"
    return "intact" if row.signed else "unsigned"


def _coming(row: Row[Any], folder: Path) -> JournalListing:
    states: dict[str, RecordingState] = {
        "incoming": "copying", "quarantined": "quarantined", "aside": "aside", "verified": "waiting"
    }  # fmt: skip
    return JournalListing(
        row.store_id, row.journal, row.writer, row.sha256, states.get(row.state, "copying"),
        "altered" if row.state == "quarantined" else "unknown", row.reason, row.bytes,
        _copied(folder / row.path, row), 0, *_times(row), row.ended_ns,
    )  # fmt: skip


def _copied(path: Path, row: Row[Any]) -> int:
    """Return how many bytes of a file have been received."""
    if row.state != "incoming":
        return int(row.bytes)
    try:
        return path.stat().st_size if row.path else 0
    except FileNotFoundError:
        return 0


_WRITERS = {folder: writer for writer, folder in FOLDERS.items()}
_KINDS: Sequence[tuple[GapKind, re.Pattern[str]]] = (
    ("to_come", re.compile(f"^{re.escape(TO_COME)}")),
    ("waiting", re.compile(f"^{re.escape(WAITING)}")),
    ("refused", re.compile(f"^{re.escape(REFUSED_GAP)}")),
    ("deleted", re.compile("^deleted")),
    ("filtered", re.compile("filter|unchanged|rate.?limit", re.IGNORECASE)),
    ("lost", re.compile("lost|drop|queue|damaged|torn|refused|corrupt|decod|columns", re.I)),
)
"""Kinds by the wording of a gap's reason, also in old records; the first match counts."""


def kind_of(reason: str) -> GapKind:
    """Return the kind of a gap from its reason; ``uncovered`` for any other text."""
    return next((kind for kind, words in _KINDS if words.search(reason)), "uncovered")


def gaps_json(look: RecordSnapshot, asked: RowQuery) -> dict[str, Any]:
    """Return the gaps of an item (all without a name) that overlap ``[from, to)``, by time.

    Journals that wait for their columns are no gap where queries read them too.
    """
    item, span = asked.item or None, (asked.from_ns, asked.to_ns)
    found = gaps_of(
        look.reader, look.catalogue, item, span, refused(look, asked.robot), look.journals
    )
    return {"gaps": [_gap(gap) for gap in found[: asked.limit]], "more": len(found) > asked.limit}


def _gap(gap: Gap) -> dict[str, Any]:
    return {
        "item": gap.item, "writer": gap.writer, "run": gap.run, "from": format_time(gap.from_ns),
        "to": format_time(gap.to_ns), "kind": kind_of(gap.reason), "reason": gap.reason,
        "count": gap.count, "publisher": gap.peer,
    }  # fmt: skip


def refused(look: RecordSnapshot, robot: str) -> Mapping[RobotStore, Sequence[RefusedFile]]:
    """Return the files of a robot's stores that arrived invalid, without a valid copy."""
    u = UPLOAD.c
    chosen = select(UPLOAD).where(u.robot == robot, u.state == "quarantined", ~in_archive())
    with look.catalogue.database.reading() as connection:
        rows = connection.execute(chosen.order_by(u.ended_ns)).all()
    found: dict[RobotStore, dict[str, RefusedFile]] = {}
    for row in rows:  # of several copies the last counts
        found.setdefault(RobotStore(row.robot, row.store_id), {})[row.journal] = _refused(row)
    return {source: list(files.values()) for source, files in found.items()}


def _refused(row: Row[Any]) -> RefusedFile:
    path = Path(row.journal)
    return RefusedFile(
        _WRITERS[path.parent.name], *run_and_number(path), row.journal, row.reason,
        row.ended_ns or row.began_ns, row.first_seq, row.end_seq, row.start_ns, row.end_ns,
    )  # fmt: skip
