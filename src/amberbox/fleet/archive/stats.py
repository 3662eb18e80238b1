"""How much is in an archive."""

from __future__ import annotations

from sqlalchemy import case, func, select

from amberbox.fleet.archive.catalogue import PUT, Catalogue
from amberbox.fleet.archive.files import Layout, tables_of
from amberbox.fleet.archive.store import RobotStats, Stats
from amberbox.fleet.archive.tables import JOURNALS


def stats(layout: Layout, catalogue: Catalogue) -> Stats:
    """Add up journals by robot, and the live files of all tables."""
    names = [table for schema in catalogue.schemas() for table, _ in tables_of(schema)]
    files = [file for name in names for file in layout.snapshot(name).files.values()]
    sizes = sum(file.bytes for file in files)
    return Stats(_robots(catalogue), len(names), len(files), sizes)


def _robots(catalogue: Catalogue) -> list[RobotStats]:
    kept = case((JOURNALS.c.raw_gone, 0), else_=JOURNALS.c.bytes)
    statement = select(
        JOURNALS.c.robot,
        func.count(),
        func.sum(kept),
        func.sum(case((JOURNALS.c.state == PUT, 1), else_=0)),
        func.sum(JOURNALS.c.rows),
        func.min(JOURNALS.c.start_ns),
        func.max(JOURNALS.c.end_ns),
    ).group_by(JOURNALS.c.robot)
    with catalogue.database.reading() as connection:
        rows = connection.execute(statement.order_by(JOURNALS.c.robot))
        return [RobotStats(str(robot), *map(int, numbers)) for robot, *numbers in rows]
