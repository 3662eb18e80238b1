"""The ASGI application: all routes of the API and the pages, and the middleware around them."""

from __future__ import annotations

from collections.abc import Sequence

from fastapi import FastAPI
from starlette.types import ASGIApp

from amberbox.core.version import __version__
from amberbox.server.http.auth import RouteRule, Routes
from amberbox.server.middleware import (
    AccessLog,
    BodyLimits,
    Hosts,
    RateLimits,
    RequestCounts,
    RequestTimer,
    SecurityHeaders,
    WaitsForAdmin,
)
from amberbox.server.services.context import Services
from amberbox.server.services.health import ReceivedCounter
from amberbox.server.web.page import add_handlers


def all_routes() -> Sequence[Routes]:
    """Load and return the routes of API and pages; the first call imports all of them."""
    from amberbox.server.routes import API, PAGES

    return *API, *PAGES


def rules() -> dict[tuple[str, str], RouteRule]:
    """Return the rule of each route, by method and path."""
    return {where: rule for routes in all_routes() for where, rule in routes.rules.items()}


def make_app(services: Services) -> FastAPI:
    """Return the application; background services are not started."""
    app = FastAPI(title="Amberbox", version=__version__, docs_url=None, redoc_url=None,
                  openapi_url=None)  # fmt: skip
    app.state.services = services
    app.state.requests, app.state.received = RequestCounts(), ReceivedCounter(services.bus)
    app.add_middleware(RequestTimer, counts=app.state.requests)
    add_handlers(app)
    app.state.routes = all_routes()
    for routes in app.state.routes:
        # not include_router: it would build every route again at the first request
        app.router.routes.extend(routes.router.routes)
    return app


def wrapped(services: Services) -> AccessLog:
    """Return the application inside its middleware; call ``close`` of the result at the end.

    The access log is outermost, so that refused requests are logged, with security headers.
    """
    settings = services.settings
    app: ASGIApp = make_app(services)
    app = BodyLimits(app)
    app = WaitsForAdmin(app, services.database)
    app = RateLimits(app, settings)
    app = Hosts(app, settings)
    app = SecurityHeaders(app, settings)
    return AccessLog(app, services.folder, settings, services.clock)
