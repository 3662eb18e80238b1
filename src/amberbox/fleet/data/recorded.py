"""Missions and incidents: those robots have told of, and those people wrote down on the server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.blackbox.missions.mission import Mission, of_record
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.fleet.archive.catalogue import Source
from amberbox.fleet.archive.files import Layout
from amberbox.fleet.archive.folder import FolderArchive
from amberbox.fleet.archive.reading import Reader
from amberbox.fleet.conclusions.entry import Entry
from amberbox.fleet.conclusions.reading import MOST, entries
from amberbox.fleet.data import remarks
from amberbox.fleet.data.look import open_catalogue
from amberbox.fleet.database.database import Database


@dataclass(frozen=True, slots=True)
class Stores:
    """What the reader of conclusions needs."""

    database: Database
    archive: FolderArchive


def missions(folder: Path, robot: str) -> list[Mission]:
    """Return a robot's missions in order of their start, with times as they are known now.

    People's are among them.
    """
    found: dict[str, Mission] = {}
    books = _Books(folder, robot)
    for entry in _entries(folder, robot, reserved.MISSION):
        try:
            mission = of_record({**_MISSION, **entry.values})
        except (msgspec.MsgspecError, TypeError, AttributeError):
            continue  # kept as it came, but no mission that could be shown
        if mission.id not in found or found[mission.id].end is None:
            found[mission.id] = mission.corrected(books.of(entry.store_id))
    with open_catalogue(folder).database.reading() as connection:
        found |= {mission.id: mission for mission in remarks.missions(connection, robot)}
    return sorted(found.values(), key=lambda mission: (mission.from_ns, mission.id))


def incidents(folder: Path, robot: str) -> list[Mapping[str, Any]]:
    """Return what a robot said last of each incident, in order of their windows."""
    found: dict[str, Mapping[str, Any]] = {}
    for entry in _entries(folder, robot, reserved.INCIDENT):
        found[str(entry.values.get("id"))] = entry.values
    return sorted(found.values(), key=_from_ns)


def _from_ns(values: Mapping[str, Any]) -> int:
    """Return when a window begins; a robot may say anything in its place."""
    from_ns = values.get("from_ns")
    return from_ns if isinstance(from_ns, int) else 0


def _entries(folder: Path, robot: str, channel: str) -> list[Entry]:
    catalogue = open_catalogue(folder)
    stores = Stores(catalogue.database, FolderArchive(folder, catalogue.database))
    return entries(stores, robot, channel, limit=MOST, newest=True)


class _Books:
    """What is known of the clocks of each of a robot's stores."""

    def __init__(self, folder: Path, robot: str) -> None:
        self._folder = folder
        self._robot = robot
        self._known: dict[str, ClockBook] = {}

    def of(self, store_id: str) -> ClockBook:
        """Return the clocks of a store."""
        if store_id not in self._known:
            source = Source(self._robot, store_id)
            reader = Reader(Layout(self._folder), open_catalogue(self._folder), [source])
            self._known[store_id] = reader.clocks(source).book
        return self._known[store_id]


_MISSION: Mapping[str, Any] = {
    "id": "", "name": "", "state": "", "outcome": "", "from_ns": 0, "to_ns": None, "who": "",
    "details": "",
}  # fmt: skip
"""What a mission's record has, should an old one lack something."""
