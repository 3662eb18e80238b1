"""Where a robot hands in its folder."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import Path, Request, Response

from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.link import body_of
from amberbox.link import limits
from amberbox.link.folders import PACKED_BYTES

routes = Routes("link", prefix=limits.PATH)

Hash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]


@routes.put("/folders/{config_hash}", "journals.upload", status_code=204)
async def put_folder(config_hash: Hash, request: Request, fleet: Fleet, who: Who) -> Response:
    """Take the folder of the robot that sends it; one that is known stays as it is."""
    robot = who.principal.id
    with fleet.threads.turn(robot):
        packed = await body_of(request, PACKED_BYTES)
        await fleet.threads.folder(partial(fleet.folders.keep, robot, config_hash, packed))
    return Response(status_code=204)
