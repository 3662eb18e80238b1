"""The app: every room of the API, with its guards, around the parts of a server."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module

from fastapi import FastAPI

from amberbox import __version__
from amberbox.fleet.api.access import Routes, Rule
from amberbox.fleet.api.errors import add_handlers
from amberbox.fleet.metrics.figures import Received
from amberbox.fleet.metrics.requests import RequestCounts, Timed
from amberbox.fleet.services import Services


def rooms() -> Mapping[str, Routes]:
    """Return the routes of all rooms, found by file name: ``routes`` in ``fleet/api/*.py``."""
    package = import_module("amberbox.fleet.api")
    names = sorted(info.name for info in pkgutil.iter_modules(package.__path__))
    found = ((name, import_module(f"{package.__name__}.{name}")) for name in names)
    return {name: module.routes for name, module in found if hasattr(module, "routes")}


def rules() -> dict[tuple[str, str], Rule]:
    """Return what each route takes, by method and path."""
    return {where: rule for routes in rooms().values() for where, rule in routes.rules.items()}


def make_app(services: Services) -> FastAPI:
    """Make the app of a server; its parts are not started."""
    app = FastAPI(title="Amberbox", version=__version__, docs_url=None, redoc_url=None,
                  openapi_url=None)  # fmt: skip
    app.state.services = services
    app.state.requests, app.state.received = RequestCounts(), Received(services.bus)
    app.add_middleware(Timed, counts=app.state.requests)
    add_handlers(app)
    app.state.rooms = rooms()
    for routes in app.state.rooms.values():
        # not include_router: it would make every route anew, at the first request
        app.router.routes.extend(routes.router.routes)
    return app
