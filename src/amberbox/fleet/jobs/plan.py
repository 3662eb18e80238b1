"""What a download consists of: one piece per robot, or per mission of each robot."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.missions.mission import Mission, named
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.data.recorded import missions
from amberbox.fleet.jobs.wanted import Wanted

_FOREIGN = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True, slots=True)
class Piece:
    """A range of one robot's record; ``folder`` is where it stands among the files."""

    robot: str
    folder: str
    from_ns: int | None
    to_ns: int | None


def pieces(
    folder: Path, wanted: Wanted, note: Callable[[str], None] = lambda text: None
) -> Iterator[Piece]:
    """Give the pieces of a download; raises UsageError for a mission that is not there.

    Where several robots are asked for, some may lack one: then that is noted.
    """
    lacking: list[tuple[str, str, UsageError]] = []
    ids: set[str] = set()
    for robot in wanted.robots:
        if not wanted.missions:
            yield Piece(robot, safe(robot), wanted.from_ns, wanted.to_ns)
            continue
        for mission in _chosen(folder, robot, wanted, lacking):
            ids.add(mission.id)
            place = f"{safe(robot)}/{safe(mission.id)}"
            yield Piece(robot, place, mission.from_ns, mission.to_ns)
    for robot, text, error in lacking:
        if not ids or len(wanted.robots) == 1:
            raise error
        if text not in ids:
            note(f"{robot}: {error.what}")


def _chosen(
    folder: Path, robot: str, wanted: Wanted, lacking: list[tuple[str, str, UsageError]]
) -> Iterable[Mission]:
    """Return the missions of a robot that are meant, each once; add what it has not."""
    known = missions(folder, robot)
    found: dict[str, Mission] = {}
    for text in wanted.missions:
        try:
            found |= {mission.id: mission for mission in named(known, text)}
        except UsageError as error:
            lacking.append((robot, text, error))
    return found.values()


def safe(name: str) -> str:
    """Make a name of a file or folder, whatever a robot calls its things."""
    return _FOREIGN.sub("_", name).lstrip(".")[:120] or "_"


def file_name(wanted: Wanted, asked_ns: int, ending: str) -> str:
    """Name the file of a download."""
    who = wanted.robots[0] if len(wanted.robots) == 1 else f"{len(wanted.robots)}-robots"
    moment = format_time(asked_ns)[:19].replace("-", "").replace(":", "")
    return f"{safe(who)}-{moment}-{wanted.format}{ending}"
