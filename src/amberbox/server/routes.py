"""Every route of the server, in the order in which requests are matched."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from amberbox.server import web
from amberbox.server.api import (
    alarms,
    audit,
    commands,
    data,
    demo,
    diagnoses,
    docs,
    experiments,
    link,
    missions,
    models,
    recordings,
    robots,
    server,
    session,
    users,
)
from amberbox.server.http.auth import Routes

API = (
    alarms.routes, audit.routes, server.clock_routes, commands.routes, demo.code_routes,
    demo.demo_routes,
    diagnoses.routes, docs.routes, recordings.download_routes, robots.enrolment_routes,
    experiments.routes,
    robots.feed_routes, recordings.fetch_routes, link.folder_routes, diagnoses.folder_routes,
    users.group_routes, server.health_routes, missions.incident_routes, data.routes,
    diagnoses.knowledge_routes, link.routes, server.metrics_routes, missions.mission_routes,
    models.routes,
    server.notification_routes, data.query_routes, recordings.recording_routes, robots.routes,
    session.routes, server.setting_routes, server.system_routes, users.token_routes,
    users.user_routes,
)  # fmt: skip

PAGES = tuple(
    routes
    for module in sorted(one.name for one in iter_modules(web.__path__))
    for routes in vars(import_module(f"{web.__name__}.{module}")).values()
    if isinstance(routes, Routes)
)
"""The routes of all modules of pages: a new page is entered nowhere."""
