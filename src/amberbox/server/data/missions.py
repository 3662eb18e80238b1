"""Missions and incidents of a robot: reported by it, or added by people on the server."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from amberbox.blackbox.journal import channels
from amberbox.blackbox.retention.missions import RecordedMission, of_record
from amberbox.blackbox.store.clocks import ClockBook
from amberbox.server import annotations as server_annotations
from amberbox.server.archive.catalogue import RobotStore
from amberbox.server.archive.delta_files import ArchiveLayout
from amberbox.server.archive.folder import FolderArchive
from amberbox.server.archive.reader import ArchiveReader
from amberbox.server.data.snapshot import open_catalogue
from amberbox.server.database import ServerDatabase
from amberbox.server.derived import MOST, DerivedRecord, derived_records


@dataclass(frozen=True, slots=True)
class OpenedStores:
    """The database and archive for ``derived_records``."""

    database: ServerDatabase
    archive: FolderArchive


def missions(folder: Path, robot: str) -> list[RecordedMission]:
    """Return a robot's missions in order of their start, with times as known now.

    Missions added by people are included.
    """
    found: dict[str, RecordedMission] = {}
    books: dict[str, ClockBook] = {}
    for entry in _entries(folder, robot, channels.MISSION):
        try:
            mission = of_record({**_MISSION, **entry.values})
        except (msgspec.MsgspecError, TypeError, AttributeError):
            continue  # stored as received, but not decodable as a mission
        if mission.id not in found or found[mission.id].end is None:
            if entry.store_id not in books:
                source = RobotStore(robot, entry.store_id)
                reader = ArchiveReader(ArchiveLayout(folder), open_catalogue(folder), [source])
                books[entry.store_id] = reader.clocks(source).book
            found[mission.id] = mission.corrected(books[entry.store_id])
    with open_catalogue(folder).database.reading() as connection:
        found |= {mission.id: mission for mission in server_annotations.missions(connection, robot)}
    return sorted(found.values(), key=lambda mission: (mission.from_ns, mission.id))


def incidents(folder: Path, robot: str) -> list[Mapping[str, Any]]:
    """Return the last state of each incident of a robot, in order of their windows."""
    found: dict[str, Mapping[str, Any]] = {}
    for entry in _entries(folder, robot, channels.INCIDENT):
        found[str(entry.values.get("id"))] = entry.values
    return sorted(found.values(), key=_from_ns)


def _from_ns(values: Mapping[str, Any]) -> int:
    """Return when a window begins (ns); 0 for any other value."""
    from_ns = values.get("from_ns")
    return from_ns if isinstance(from_ns, int) else 0


def _entries(folder: Path, robot: str, channel: str) -> list[DerivedRecord]:
    catalogue = open_catalogue(folder)
    stores = OpenedStores(catalogue.database, FolderArchive(folder, catalogue.database))
    return derived_records(stores, robot, channel, limit=MOST, newest=True)


_MISSION: Mapping[str, Any] = {
    "id": "", "name": "", "state": "", "outcome": "", "from_ns": 0, "to_ns": None, "who": "",
    "details": "",
}  # fmt: skip
"""Default values of a mission's record, for fields that an old one lacks."""
