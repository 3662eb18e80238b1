"""Which journals of a robot's store are here, for robots that ask whether theirs are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Row, Select, and_, select

from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.database.database import Database
from amberbox.fleet.uploads.tables import UPLOAD
from amberbox.link.holdings import Answer, Copy, Question, compared


def answer(database: Database, root: Path, robot: str, store_id: str, asked: Question) -> Answer:
    """List what is held in the stretches in which the robot counts on something else. Blocks."""
    return compared(asked, held(database, root, robot, store_id))


def held(database: Database, root: Path, robot: str, store_id: str) -> Iterator[Copy]:
    """Give the journals of a store whose file is here, or was deleted here on purpose.

    What the database names and the disk has no more is not held: it may have been restored from an
    older copy than the database.
    """
    u = UPLOAD.c
    mine = and_(u.robot == robot, u.store_id == store_id, u.state != "incoming")
    with database.reading() as connection:
        rows = connection.execute(known_uploads().where(mine)).all()
    sizes: dict[str, dict[str, int]] = {}
    for row in rows:
        folder, _, name = row.path.rpartition("/")
        if folder not in sizes:
            sizes[folder] = _sizes(root / folder)
        if row.raw_gone or sizes[folder].get(name) == row.bytes:
            yield Copy(row.journal, row.bytes, row.state != "quarantined")


def known_uploads() -> Select[Any]:
    """Choose what came, with ``raw_gone``: whether the archive has deleted it on purpose."""
    u, j = UPLOAD.c, JOURNALS.c
    same = and_(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal,
                j.sha256 == u.sha256)  # fmt: skip
    return select(UPLOAD, j.raw_gone).select_from(UPLOAD.outerjoin(JOURNALS, same))


def is_held(root: Path, row: Row[Any]) -> bool:
    """Tell whether the file of one of ``known_uploads`` is here, or was deleted on purpose."""
    if row.raw_gone or row.state == "incoming":
        return True
    try:
        return (root / str(row.path)).stat().st_size == int(row.bytes)
    except FileNotFoundError:
        return False


def _sizes(folder: Path) -> dict[str, int]:
    try:
        with os.scandir(folder) as entries:
            return {entry.name: entry.stat().st_size for entry in entries}
    except FileNotFoundError:
        return {}
