"""The app: every room of the API and every page, with its guards, around a server's parts."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from importlib import import_module

from fastapi import FastAPI

from amberbox import __version__
from amberbox.fleet.api.access import Routes, Rule
from amberbox.fleet.metrics.figures import Received
from amberbox.fleet.metrics.requests import RequestCounts, Timed
from amberbox.fleet.pages.errors import add_handlers
from amberbox.fleet.services import Services

ROOMS = ("amberbox.fleet.api", "amberbox.fleet.pages")


def rooms() -> Mapping[str, Routes]:
    """Return the routes of all rooms: ``routes`` of each file below ``ROOMS``, by its name."""
    found = (import_module(name) for package in ROOMS for name in _modules(package))
    return {_short(module.__name__): module.routes for module in found if hasattr(module, "routes")}


def _short(module: str) -> str:
    return module.removeprefix("amberbox.fleet.").removeprefix("api.")


def rules() -> dict[tuple[str, str], Rule]:
    """Return what each route takes, by method and path."""
    return {where: rule for routes in rooms().values() for where, rule in routes.rules.items()}


def _modules(package: str) -> Sequence[str]:
    path = import_module(package).__path__
    found = pkgutil.walk_packages(path, f"{package}.")
    return sorted(info.name for info in found if not info.ispkg)


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
