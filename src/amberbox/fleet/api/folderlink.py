"""Where a robot hands in its folder."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import HTTPException, Path, Request, Response

from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.link import limits
from amberbox.link.folders import PACKED_BYTES

routes = Routes("link", prefix=limits.PATH)

Hash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]


@routes.put("/folders/{config_hash}", "journals.upload", status_code=204)
async def put_folder(config_hash: Hash, request: Request, fleet: Fleet, who: Who) -> Response:
    """Take the folder of the robot that sends it; one that is known stays as it is."""
    packed = await _body(request, PACKED_BYTES)
    await asyncio.to_thread(fleet.folders.keep, who.principal.id, config_hash, packed)
    return Response(status_code=204)


async def _body(request: Request, most: int) -> bytes:
    """Read what is sent; raises 413 as soon as it is too much."""
    found = bytearray()
    async for piece in request.stream():
        found += piece
        if len(found) > most:
            raise HTTPException(413, f"a folder has at most {most} bytes, packed")
    return bytes(found)
