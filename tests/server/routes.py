"""The routes and sockets of an app, read from the app itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from starlette.routing import Mount, Route, WebSocketRoute

SOCKET = "SOCKET"


def all_routes(app: Any) -> set[tuple[str, str]]:
    """Return method and path of each; ``HEAD`` is left out if ``GET`` is answered."""
    found = set(_walk(app.routes, ""))
    return {one for one in found if one[0] != "HEAD" or ("GET", one[1]) not in found}


def _walk(routes: list[Any], prefix: str) -> Iterator[tuple[str, str]]:
    for route in routes:
        if isinstance(route, Mount):
            yield from (
                _walk(route.routes, prefix + route.path)
                if route.routes
                else [("MOUNT", prefix + route.path)]
            )
        elif isinstance(route, WebSocketRoute):
            yield SOCKET, prefix + route.path
        elif isinstance(route, Route):
            yield from ((method, prefix + route.path) for method in route.methods or ("ANY",))
        else:  # what FastAPI keeps of a router that was included
            inner = getattr(route, "original_router", None)
            assert inner is not None, f"a route of a kind that this test does not know: {route!r}"
            yield from _walk(inner.routes, prefix + str(route.include_context.prefix))
