"""The documentation of the API: a page of our own, made on the server, and its OpenAPI."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from amberbox.fleet.api.access import Routes, Rule
from amberbox.fleet.api.described import described, openapi_of
from amberbox.fleet.api.errors import PROBLEMS
from amberbox.fleet.services import Services

routes = Routes("description", prefix="/api")

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HTML: dict[int | str, dict[str, Any]] = {200: {"description": "the page"}}
_CSS: dict[int | str, dict[str, Any]] = {
    200: {"description": "its style", "content": {"text/css": {"schema": {"type": "string"}}}}
}


@routes.get("/v1/openapi.json", "own.read")
def read_openapi(request: Request) -> dict[str, Any]:
    """Return the description of the API as OpenAPI 3.1, with who may do what (``x-action``)."""
    return openapi_of(request.app, _rules(request.app))


@routes.get("/docs", "own.read", response_class=HTMLResponse, responses=_HTML)
def read_page(request: Request) -> HTMLResponse:
    """Show this page."""
    app: FastAPI = request.app
    if not hasattr(app.state, "docs_page"):
        app.state.docs_page = _page(app, request.app.state.services)
    headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-store"}
    return HTMLResponse(app.state.docs_page, headers=headers)


@routes.get("/docs.css", "own.read", response_class=Response, responses=_CSS)
def read_style() -> Response:
    """Return how this page looks."""
    return Response((_HERE / "docs_page.css").read_text(encoding="utf-8"), media_type="text/css")


def _page(app: FastAPI, services: Services) -> str:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    found = openapi_of(app, _rules(app))
    listed = described(found, app.state.rooms, services.settings.public_url)
    problems = {status: said["description"] for status, said in PROBLEMS.items()}
    return environment.get_template("docs_page.html").render(
        rooms=listed, problems=problems, version=app.version
    )


def _rules(app: FastAPI) -> dict[tuple[str, str], Rule]:
    rooms: Mapping[str, Routes] = app.state.rooms
    return {where: rule for routes in rooms.values() for where, rule in routes.rules.items()}
