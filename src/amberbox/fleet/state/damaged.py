"""Files of robots that the server has set aside because they are damaged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from sqlalchemy import Connection, Select, case, exists, func, select, union_all

from amberbox.core.clock import NS
from amberbox.fleet.archive.catalogue import REFUSED
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.uploads.tables import UPLOAD

NEW_NS: Final = 24 * 3600 * NS
"""So long a damaged file is new: somebody should look why."""


@dataclass(frozen=True, slots=True)
class Damaged:
    """How many files of a robot are set aside as damaged; ``new`` of them came lately."""

    count: int = 0
    new: int = 0


def damaged_files(connection: Connection, now_ns: int) -> Mapping[str, Damaged]:
    """Return the robots of which files are damaged; a file that came whole later is none."""
    found = union_all(_refused_at_once(), _refused_later()).subquery()
    is_new = case((found.c.at_ns >= now_ns - NEW_NS, 1), else_=0)
    counted = select(found.c.robot, func.count(), func.sum(is_new)).group_by(found.c.robot)
    rows = connection.execute(counted)
    return {robot: Damaged(int(count), int(new)) for robot, count, new in rows}


def _refused_at_once() -> Select[tuple[str, int]]:
    """Choose files that came damaged; one that came so twice is one."""
    u, j = UPLOAD.c, JOURNALS.c
    held = exists().where(j.robot == u.robot, j.store_id == u.store_id, j.file == u.journal)
    of = (u.robot, u.store_id, u.journal)
    chosen = select(u.robot, func.max(u.ended_ns).label("at_ns"))
    return chosen.where(u.state == "quarantined", ~held).group_by(*of)


def _refused_later() -> Select[tuple[str, int]]:
    """Choose files that had changed on the server before their rows were read."""
    return select(JOURNALS.c.robot, JOURNALS.c.put_ns).where(JOURNALS.c.state == REFUSED)
