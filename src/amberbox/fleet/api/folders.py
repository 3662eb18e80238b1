"""Robots' folders: technicians read what a robot was told to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException, Path
from fastapi.responses import PlainTextResponse

from amberbox.core.timetext import format_time
from amberbox.fleet.api.access import Fleet, OfRobot, Routes, Who
from amberbox.fleet.folders.folders import KnownFolder
from amberbox.fleet.folders.shelf import FileInfo

routes = Routes("folders")

Hash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Path(max_length=512)]


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder that a robot had; ``masked`` files had secrets in them when they came."""

    config_hash: str
    received: str
    files: int
    bytes: int
    masked: int
    current: bool


@dataclass(frozen=True, slots=True)
class FolderList:
    """The folders of a robot, the newest first; ``current`` is what it stated last."""

    current: str
    folders: list[Folder]


@dataclass(frozen=True, slots=True)
class FolderFiles:
    """The files of one folder."""

    config_hash: str
    files: list[FileInfo]


@routes.get("/robots/{robot}/folder", "folder.read")
def list_folders(robot: OfRobot, fleet: Fleet) -> FolderList:
    """List the folders that a robot had, as far as they are kept."""
    current = fleet.folders.current(robot.id)
    found = fleet.folders.kept(robot.id)
    return FolderList(current, [_shown(folder, current) for folder in found])


@routes.get("/robots/{robot}/folder/{config_hash}", "folder.read")
def list_files(robot: OfRobot, config_hash: Hash, fleet: Fleet) -> FolderFiles:
    """List the files of a folder. Secrets in them are masked."""
    files = fleet.folders.files(robot.id, config_hash)
    if files is None:
        raise HTTPException(404, "this folder is not here")
    return FolderFiles(config_hash, list(files))


@routes.get(
    "/robots/{robot}/folder/{config_hash}/{name:path}", "folder.read",
    response_class=PlainTextResponse,
)  # fmt: skip
def read_file(
    robot: OfRobot, config_hash: Hash, name: FileName, fleet: Fleet, who: Who
) -> PlainTextResponse:
    """Return a file of a folder, as text."""
    data = fleet.folders.read(robot.id, config_hash, name)
    if data is None:
        raise HTTPException(404, "there is no such file, or the folder is not here")
    with fleet.database.begin() as connection:
        details = {"config_hash": config_hash, "file": name}
        who.note(connection, fleet.clock.wall_ns(), "folder.read", robot.id, details=details)
    headers = {"X-Content-Type-Options": "nosniff"}
    return PlainTextResponse(data.decode("utf-8", "replace"), headers=headers)


def _shown(folder: KnownFolder, current: str) -> Folder:
    return Folder(
        folder.config_hash, format_time(folder.received_ns), folder.files, folder.bytes,
        folder.masked, folder.config_hash == current,
    )  # fmt: skip
