"""The page of learnt detectors: let a model be learnt from missions, its progress, its versions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any

from fastapi import Query, Request, Response
from starlette.responses import RedirectResponse

from amberbox.core.errors import UsageError
from amberbox.detection.learn import DEFAULT_DETECTORS, make_detectors
from amberbox.detection.model_file import detector_names
from amberbox.server.http.auth import Fleet, Who
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.models import following_models, list_models, model_takers
from amberbox.server.web import text
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue

routes = PageRoutes()

_MOST = 200
_Robots = Annotated[list[Annotated[str, Query(max_length=64)]], Query(max_length=100)]


@routes.get("/detectors", "models.read", each=True)
def show_models(
    request: Request, fleet: Fleet, who: Who,
    robot: _Robots = [],  # noqa: B006 - FastAPI copies it
) -> Response:  # fmt: skip
    """Show the models, and the form that starts one, with ``robot`` chosen."""
    return render(
        request, "learnt_models/models.html", robots=_robots(fleet, who), chosen=robot,
        detectors=_detectors(), usual=DEFAULT_DETECTORS, **_listed(fleet, who),
    )  # fmt: skip


@routes.get("/models", "models.read", each=True)
def show_models_where_they_were(request: Request) -> Response:
    """Lead from the page's former address to its present one, with the same query."""
    query = request.url.query
    return RedirectResponse(f"/detectors?{query}" if query else "/detectors", 308)


@routes.get("/pieces/models", "models.read", each=True)
def show_model_list(request: Request, fleet: Fleet, who: Who) -> Response:
    """Return the fragment with the list of models."""
    return render(request, "learnt_models/list.html", **_listed(fleet, who))


@cache
def simple_detectors() -> tuple[str, ...]:
    """Return the detectors that need no options."""
    found = []
    for name in detector_names():
        try:
            make_detectors([name], {})
        except UsageError:
            continue
        found.append(name)
    return tuple(found)


def _detectors() -> Mapping[str, str]:
    """Return what each simple detector notices; empty for one from elsewhere."""
    texts = catalogue().texts
    return {name: texts.get(f"learnt_models.detector.{name}", "") for name in simple_detectors()}


def _robots(fleet: Services, who: Caller) -> list[str]:
    with fleet.database.reading() as connection:
        return [robot.id for robot in who.robots(connection, "models.write")]


def _listed(fleet: Services, who: Caller) -> Mapping[str, Any]:
    found = list_models(fleet, who)
    following = following_models(fleet, who, found[:_MOST])
    return {
        "lines": found[:_MOST], "more": len(found) > _MOST,
        "may_write": who.may_some("models.write"), "may_fetch": who.may_some("data.download"),
        "takers": model_takers(fleet, who), "following": following,
        "size": text.size, "percent": text.percent,
    }  # fmt: skip
