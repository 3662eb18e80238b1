"""The server's own figures, for Prometheus."""

from __future__ import annotations

from typing import Any

from fastapi import Request, Response

from amberbox.fleet.api.access import Fleet, Routes
from amberbox.fleet.metrics.figures import families
from amberbox.fleet.metrics.text import CONTENT_TYPE, written

routes = Routes("metrics")

_ABOUT: dict[int | str, dict[str, Any]] = {
    200: {"description": "samples", "content": {"text/plain": {"schema": {"type": "string"}}}}
}


@routes.get("/metrics", "metrics.read", responses=_ABOUT, response_class=Response)
def read_metrics(fleet: Fleet, request: Request) -> Response:
    """Return the figures of the server in Prometheus' text format."""
    state = request.app.state
    found = [*families(fleet, state.received), *state.requests.families()]
    return Response(written(found), media_type=CONTENT_TYPE)
