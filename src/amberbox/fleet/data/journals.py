"""The journals of a robot as people see them: what they cover, whether they hold, how long."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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

from amberbox.fleet.archive.catalogue import COMMITTED, REFUSED
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.uploads.tables import UPLOAD

Integrity = Literal["intact", "altered", "missing", "deleted", "unsigned", "unknown"]
Span = tuple[int | None, int | None]
"""From and to, in ns; None is open."""
State = Literal["copying", "waiting", "in_columns", "refused", "quarantined", "aside"]


@dataclass(frozen=True, slots=True)
class Recording:
    """A journal on the server, or on its way; times are those of receipt on the robot.

    They are None where they are not known: of what is being copied, and of most that is damaged.

    ``integrity``: ``unsigned`` is a journal that holds but stands behind the last head that the
    robot signed; ``deleted`` one that retention took. By size only: ``altered`` also comes from a
    check of its content.
    """

    store_id: str
    journal: str
    keeping: str
    sha256: str
    state: State
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
) -> list[Recording]:  # fmt: skip
    """List journals by name (``store/folder/file``), behind that of a name.

    With a span those that meet it, and those of which it is not known what they cover, unless they
    came before it. Only the files of those that are listed are looked at.
    """
    held = {_name(row.store_id, row.file): row for row in connection.execute(_held(robot, span))}
    coming = {
        _name(row.store_id, row.journal): row for row in connection.execute(_not_held(robot, span))
    }
    names = sorted(name for name in (*held, *coming) if name > after)[:limit]
    base = Layout(folder).journals / robot
    return [
        _of_archive(held[name], f"{base}/{name}") if name in held else _coming(coming[name], folder)
        for name in names
    ]


def _name(store_id: str, journal: str) -> str:
    return f"{store_id}/{journal}"


def _held(robot: str, span: Span) -> Select[Any]:
    """Choose the journals of the archive; ``why`` is there only where one was refused."""
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
    """Choose the journals that the archive does not have: on their way, aside, refused at once."""
    j, u = JOURNALS.c, UPLOAD.c
    held = exists().where(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal)
    meets = and_(true(), *_meets(UPLOAD, span))
    late = or_(u.ended_ns.is_(None), u.ended_ns >= (span[0] or 0))
    unknown = and_(u.end_ns == 0, late)
    return select(UPLOAD).where(u.robot == robot, ~held, or_(unknown, meets))


def _times(row: Row[Any]) -> tuple[int | None, int | None]:
    """Return from and to; a file of which they could not be read is entered with zeros."""
    return (row.start_ns, row.end_ns) if row.end_ns else (None, None)


def _meets(table: Table, span: Span) -> list[ColumnElement[bool]]:
    from_ns, to_ns = span
    found = [] if from_ns is None else [table.c.end_ns >= from_ns]
    return found + ([] if to_ns is None else [table.c.start_ns < to_ns])


def _of_archive(row: Row[Any], path: str) -> Recording:
    states: dict[str, State] = {COMMITTED: "in_columns", REFUSED: "refused"}
    return Recording(
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


def _coming(row: Row[Any], folder: Path) -> Recording:
    states: dict[str, State] = {
        "incoming": "copying", "quarantined": "quarantined", "aside": "aside", "verified": "waiting"
    }  # fmt: skip
    return Recording(
        row.store_id, row.journal, row.writer, row.sha256, states.get(row.state, "copying"),
        "altered" if row.state == "quarantined" else "unknown", row.reason, row.bytes,
        _copied(folder / row.path, row), 0, *_times(row), row.ended_ns,
    )  # fmt: skip


def _copied(path: Path, row: Row[Any]) -> int:
    """How much of a file has come."""
    if row.state != "incoming":
        return int(row.bytes)
    try:
        return path.stat().st_size if row.path else 0
    except FileNotFoundError:
        return 0
