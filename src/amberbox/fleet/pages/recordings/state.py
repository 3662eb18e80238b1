"""How far the copying of robots' recordings is, by figures that cost little to ask for often."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Select, case, func, select

from amberbox.blackbox.journal import reserved
from amberbox.fleet.archive.catalogue import PUT
from amberbox.fleet.archive.tables import JOURNALS
from amberbox.fleet.data.tables import INCIDENT, MISSION, MISSION_NOTE
from amberbox.fleet.fetches.tables import FETCH
from amberbox.fleet.linkend.tables import ROW
from amberbox.fleet.uploads.tables import UPLOAD


@dataclass(frozen=True, slots=True)
class Copying:
    """Journals of a robot that are on their way, and how much of them has come."""

    files: int = 0
    bytes: int = 0
    copied: int = 0


@dataclass(frozen=True, slots=True)
class Held:
    """What the server holds of a robot; ``stamp`` is another one whenever something has changed."""

    files: int = 0
    bytes: int = 0
    rows: int = 0
    waiting: int = 0
    copying: Copying = Copying()
    stamp: str = ""


def held(connection: Connection, folder: Path, robots: Sequence[str]) -> Mapping[str, Held]:
    """Return what is held of each of some robots, and how far their copying is."""
    sums = {row.robot: row for row in connection.execute(_sums(robots))}
    coming = _coming(connection, folder, robots)
    stamps = _stamps(connection, robots)
    return {
        robot: replace(
            _figures(sums[robot]) if robot in sums else Held(),
            copying=coming.get(robot, Copying()), stamp="-".join(stamps[robot]),
        )
        for robot in robots
    }  # fmt: skip


def _figures(row: Any) -> Held:
    return Held(int(row.files), int(row.size), int(row.lines), int(row.waiting))


def _sums(robots: Sequence[str]) -> Select[Any]:
    here, table = JOURNALS.c.raw_gone.is_(False), JOURNALS.c
    return (
        select(
            table.robot,
            func.sum(case((here, 1), else_=0)).label("files"),
            func.sum(case((here, table.bytes), else_=0)).label("size"),
            func.sum(case((table.columns_gone.is_(False), table.rows), else_=0)).label("lines"),
            func.sum(case((table.state == PUT, 1), else_=0)).label("waiting"),
        )
        .where(table.robot.in_(robots))
        .group_by(table.robot)
    )


def _coming(connection: Connection, folder: Path, robots: Sequence[str]) -> dict[str, Copying]:
    found: dict[str, Copying] = {}
    wanted = select(UPLOAD).where(UPLOAD.c.robot.in_(robots), UPLOAD.c.state == "incoming")
    for row in connection.execute(wanted):
        known = found.get(row.robot, Copying())
        copied = known.copied + _come(folder / row.path) if row.path else known.copied
        found[row.robot] = Copying(known.files + 1, known.bytes + row.bytes, copied)
    return found


def _come(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _stamps(connection: Connection, robots: Sequence[str]) -> dict[str, list[str]]:
    """Sum up everything that pages about recordings show: who asks again sees what is new."""
    found: dict[str, list[str]] = {robot: [] for robot in robots}
    for chosen in _questions():
        table = chosen.selected_columns[0]
        sums = {
            row[0]: ".".join(str(value or 0) for value in row[1:])
            for row in connection.execute(chosen.where(table.in_(robots)).group_by(table))
        }
        for robot in robots:
            found[robot].append(sums.get(robot, ""))
    return found


def _questions() -> Iterator[Select[Any]]:
    j, count = JOURNALS.c, func.count()
    flags = func.sum(case((j.raw_gone, 1), else_=0) + case((j.columns_gone, 1), else_=0))
    yield select(j.robot, count, func.max(j.put_ns), flags, func.max(j.batch), _states(j.state))
    yield select(UPLOAD.c.robot, count, func.max(UPLOAD.c.ended_ns), _sum(UPLOAD.c.signed))
    yield select(MISSION.c.robot, count, func.max(MISSION.c.to_ns))
    yield select(MISSION_NOTE.c.robot, count)
    yield select(INCIDENT.c.robot, count, func.max(INCIDENT.c.released_ns))
    yield select(FETCH.c.robot, count, func.max(FETCH.c.ended_ns), _states(FETCH.c.state),
                 func.sum(func.length(FETCH.c.files)))  # fmt: skip
    told = ROW.c.channel.in_((reserved.MISSION, reserved.INCIDENT))
    yield select(ROW.c.robot, count, func.max(ROW.c.log_ns)).where(told)


def _states(column: Any) -> Any:
    """Return a number that is another one when rows go from one state into another."""
    return func.sum(func.length(column))


def _sum(flag: Any) -> Any:
    return func.sum(case((flag, 1), else_=0))
