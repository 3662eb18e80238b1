"""Errors on pages: the page to sign in, or a page that says what is wrong and what to do."""

from __future__ import annotations

from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import RedirectResponse, Response

from amberbox.core.errors import AmberboxError
from amberbox.fleet.api import errors as api
from amberbox.fleet.pages.page import render, visitor
from amberbox.fleet.pages.strings import catalogue

PROGRAMS = ("/api/v1/", "/link/", "/static/")
"""Below these nobody looks at a page: errors are JSON there."""
_EXPLAINED = ("401", "403", "404", "429", "503")


def add_handlers(app: FastAPI) -> None:
    """Make an app answer errors as pages where people look, as JSON elsewhere."""
    app.add_exception_handler(AmberboxError, _known)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _invalid)


def is_page(request: Request) -> bool:
    """Tell whether a person waits for a page: modules that ask for JSON say so."""
    method = request.scope.get("method")  # a robot's WebSocket has none
    wants_json = request.headers.get("accept", "").startswith("application/json")
    return method == "GET" and not wants_json and not request.url.path.startswith(PROGRAMS)


async def _known(request: Request, found: Exception) -> Response:
    assert isinstance(found, AmberboxError)
    if not is_page(request):
        return await api.say_known(request, found)
    return await run_in_threadpool(_page, request, api.status_of(found), found.what, found.hint)


async def _http(request: Request, found: Exception) -> Response:
    assert isinstance(found, HTTPException)
    if not is_page(request):
        return await api.say_http(request, found)
    if found.status_code == 401:
        return RedirectResponse(f"/sign-in?next={quote(_wanted(request), safe='')}", 303)
    me = await run_in_threadpool(visitor, request)
    if found.status_code == 403 and me is not None and me.principal.must_change:
        return RedirectResponse("/account", 303)
    what = str(found.detail) if found.detail != "Not Found" else catalogue().text("error.no_page")
    return await run_in_threadpool(_page, request, found.status_code, what, "")


async def _invalid(request: Request, found: Exception) -> Response:
    assert isinstance(found, RequestValidationError)
    if not is_page(request):
        return await api.say_invalid(request, found)
    first = found.errors()[0]
    place = ".".join(str(part) for part in first["loc"][1:])
    return await run_in_threadpool(_page, request, 400, f"{place}: {first['msg']}", "")


def _page(request: Request, status: int, what: str, hint: str) -> Response:
    name = str(status) if str(status) in _EXPLAINED else "other"
    hint = hint or catalogue().text(f"error.hint.{name}")
    title = catalogue().text(f"error.title.{name}")
    return render(request, "error.html", status, title=title, what=what, hint=hint)


def _wanted(request: Request) -> str:
    query = f"?{request.url.query}" if request.url.query else ""
    return request.url.path + query
