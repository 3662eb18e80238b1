"""The app as it is served: with all layers around it that do not know what is asked."""

from __future__ import annotations

from dataclasses import dataclass

from amberbox.fleet.services import Services
from amberbox.fleet.serving.accesslog import AccessLog
from amberbox.fleet.serving.app import make_app
from amberbox.fleet.serving.asgi import ASGIApp
from amberbox.fleet.serving.bodies import BodyLimits
from amberbox.fleet.serving.headers import SecurityHeaders
from amberbox.fleet.serving.hosts import Hosts
from amberbox.fleet.serving.rates import RateLimits
from amberbox.fleet.serving.waiting import WaitsForAdmin


@dataclass(frozen=True, slots=True)
class Served:
    """The whole application; ``log`` is closed at the end."""

    app: ASGIApp
    log: AccessLog


def wrapped(services: Services) -> Served:
    """Put the layers around the app: what is refused is logged and has its headers, too."""
    settings = services.settings
    app: ASGIApp = make_app(services)
    app = BodyLimits(app)
    app = WaitsForAdmin(app, services.database)
    app = RateLimits(app, settings)
    app = Hosts(app, settings)
    app = SecurityHeaders(app, settings)
    log = AccessLog(app, services.folder, settings, services.clock)
    return Served(log, log)
