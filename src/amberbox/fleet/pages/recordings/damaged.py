"""Files that were set aside as damaged: who may download data may take them along as they are."""

from __future__ import annotations

from typing import Annotated

from fastapi import HTTPException, Path
from fastapi.responses import FileResponse
from sqlalchemy import select

from amberbox.fleet.api.access import Fleet, OfRobot, Who
from amberbox.fleet.api.forms import download
from amberbox.fleet.pages.page import Pages
from amberbox.fleet.uploads.tables import UPLOAD

routes = Pages()

_DIGEST = Annotated[str, Path(max_length=64)]
_TYPE = "application/octet-stream"


@routes.get("/recordings/{robot}/damaged/{sha256}", "data.download")
def fetch_damaged(fleet: Fleet, who: Who, robot: OfRobot, sha256: _DIGEST) -> FileResponse:
    """Fetch a file that was set aside as damaged, by the hash that the robot gave of it."""
    u = UPLOAD.c
    chosen = select(UPLOAD).where(u.robot == robot.id, u.sha256 == sha256, u.state == "quarantined")
    with fleet.database.begin() as connection:
        row = connection.execute(chosen).first()
        path = fleet.folder / row.path if row and row.path else None
        if row is None or path is None or not path.is_file():
            raise HTTPException(404, "there is no such damaged file: it may have been deleted")
        details = {"robot": robot.id, "bytes": row.bytes}
        now_ns = fleet.clock.wall_ns()
        who.note(connection, now_ns, "downloads.fetch", row.journal, details=details)
    name = f"damaged-{sha256[:16]}.mcap"
    return FileResponse(path, media_type=_TYPE, headers=download(name))
