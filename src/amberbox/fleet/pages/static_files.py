"""The route to what browsers load beside pages."""

from __future__ import annotations

from fastapi import HTTPException, Request, Response

from amberbox.fleet.api.access import Open, Routes
from amberbox.fleet.pages.assets import assets, version

routes = Routes(prefix="")

_FOR_EVER = "public, max-age=31536000, immutable"


@routes.get(
    "/static/{digest}/{path:path}",
    Open("how pages look and what runs in them: the same for everybody"),
    include_in_schema=False,
)
def read_asset(request: Request, digest: str, path: str) -> Response:
    """Return an asset; one of another version is answered with today's, not to be kept."""
    found = assets().get(path)
    if found is None:
        raise HTTPException(404, "there is no such file")
    headers = {"Cache-Control": _FOR_EVER if digest == version() else "no-cache",
               "Vary": "Accept-Encoding"}  # fmt: skip
    packs = "gzip" in request.headers.get("accept-encoding", "")
    if packs:
        headers["Content-Encoding"] = "gzip"
    return Response(found.packed if packs else found.data, headers=headers,
                    media_type=found.media_type)  # fmt: skip
