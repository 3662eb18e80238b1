"""The journals of a robot as people see them: what they cover, whether they hold, how long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import Connection, Row, select

from amberbox.fleet.archive.catalogue import COMMITTED, REFUSED
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.journal import decode
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.uploads.tables import UPLOAD

Integrity = Literal["intact", "altered", "missing", "deleted", "unsigned", "unknown"]
State = Literal["copying", "waiting", "in_columns", "refused", "quarantined", "aside"]


@dataclass(frozen=True, slots=True)
class Recording:
    """A journal on the server, or on its way; times are those of receipt on the robot.

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
    from_ns: int
    to_ns: int
    came_ns: int | None


def recordings(
    connection: Connection, folder: Path, robot: str, after: str = "", limit: int = 100
) -> list[Recording]:
    """List journals by name (``store/folder/file``), behind that of a name."""
    held = _held(connection, folder, robot)
    coming = [one for one in _coming(connection, robot, folder) if _name(one) not in held]
    found = {**held, **{_name(one): one for one in coming}}
    names = sorted(name for name in found if name > after)
    return [found[name] for name in names[:limit]]


def _name(one: Recording) -> str:
    return f"{one.store_id}/{one.journal}"


def _held(connection: Connection, folder: Path, robot: str) -> dict[str, Recording]:
    signed = {
        (row.store_id, row.journal)
        for row in connection.execute(
            select(UPLOAD.c.store_id, UPLOAD.c.journal).where(
                UPLOAD.c.robot == robot, UPLOAD.c.signed.is_(True)
            )
        )
    }
    rows = connection.execute(select(JOURNALS).where(JOURNALS.c.robot == robot)).all()
    layout = Layout(folder)
    found = (_of_archive(row, layout, (row.store_id, row.file) in signed) for row in rows)
    return {_name(one): one for one in found}


def _of_archive(row: Row[Any], layout: Layout, signed: bool) -> Recording:
    reason = decode(row.facts).refused if row.state == REFUSED else ""
    states: dict[str, State] = {COMMITTED: "in_columns", REFUSED: "refused"}
    path = layout.journal(row.robot, row.store_id, row.file)
    return Recording(
        row.store_id, row.file, row.keeping, row.sha256, states.get(row.state, "waiting"),
        _integrity(row, path, signed), reason, row.bytes, row.bytes, row.rows, row.start_ns,
        row.end_ns, row.put_ns,
    )  # fmt: skip


def _integrity(row: Row[Any], path: Path, signed: bool) -> Integrity:
    if row.raw_gone:
        return "deleted"
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        return "missing"
    if row.state == REFUSED or size != row.bytes:
        return "altered"
    return "intact" if signed else "unsigned"


def _coming(connection: Connection, robot: str, folder: Path) -> Sequence[Recording]:
    states: dict[str, State] = {
        "incoming": "copying", "quarantined": "quarantined", "aside": "aside", "verified": "waiting"
    }  # fmt: skip
    rows = connection.execute(select(UPLOAD).where(UPLOAD.c.robot == robot)).all()
    return [
        Recording(
            row.store_id, row.journal, row.writer, row.sha256, states.get(row.state, "copying"),
            "altered" if row.state == "quarantined" else "unknown", row.reason, row.bytes,
            _copied(folder / row.path, row), 0, row.start_ns, row.end_ns, row.ended_ns,
        )
        for row in rows
    ]  # fmt: skip


def _copied(path: Path, row: Row[Any]) -> int:
    """How much of a file has come."""
    if row.state != "incoming":
        return int(row.bytes)
    try:
        return path.stat().st_size if row.path else 0
    except FileNotFoundError:
        return 0
