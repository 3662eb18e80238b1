"""The folder that a robot had at an instant."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from sqlalchemy import select

from amberbox.consult.declared import Declared, declared
from amberbox.core.errors import UsageError
from amberbox.fleet.database.database import Database
from amberbox.fleet.folders.shelf import Shelf
from amberbox.fleet.folders.tables import FOLDER
from amberbox.fleet.linkend.tables import ROBOT

_SHOWN = 12


def folder_of_then(
    folder: Path, database: Database, robot: str, wanted: str, said: str
) -> tuple[Declared, tuple[str, ...]]:
    """Return what a robot's folder declares, and notes about which one it is.

    ``wanted`` is the hash that somebody names, ``said`` the one that the robot's watcher named at
    the time; without either it is the folder that the robot stated last. Raises UsageError where
    that folder is not here: another one would explain what was found by other monitors.
    """
    shelf, config_hash = Shelf(folder), wanted or said or _stated(database, robot)
    place = shelf.place(robot, config_hash) if config_hash else None
    if place is None or not place.is_dir():
        raise _not_here(database, robot, config_hash)
    found = _read(place, robot, config_hash)
    if not said or said == config_hash:
        return found, ()
    return found, (f"its watcher had the folder {said[:_SHOWN]} then, not this one",)


@lru_cache(maxsize=4)
def _read(place: Path, robot: str, config_hash: str) -> Declared:
    """Read a folder once per worker: one that stands on the shelf never changes."""
    return declared(place, robot, config_hash)


def _stated(database: Database, robot: str) -> str:
    chosen = select(ROBOT.c.config_hash).where(ROBOT.c.robot == robot)
    with database.reading() as connection:
        stated = str(connection.execute(chosen).scalar() or "")
        known = connection.execute(
            select(FOLDER.c.config_hash)
            .where(FOLDER.c.robot == robot)
            .order_by(FOLDER.c.received_ns.desc())
        )
        hashes = [str(name) for name in known.scalars()]
    return stated if stated in hashes or not hashes else hashes[0]


def _not_here(database: Database, robot: str, config_hash: str) -> UsageError:
    chosen = select(FOLDER.c.config_hash).where(FOLDER.c.robot == robot)
    with database.reading() as connection:
        known = [str(name)[:_SHOWN] for name in connection.execute(chosen).scalars()]
    what = f"the folder that {robot} had then is not here"
    if not config_hash:
        what = f"the folder of {robot} has not come yet"
    elif known:
        return UsageError(
            f"{what}: {config_hash[:_SHOWN]}", f"name another one to ask with: {', '.join(known)}"
        )
    return UsageError(what, "it sends its folder when it connects, if its Amberbox is new enough")
