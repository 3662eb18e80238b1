"""Shared by all pages: routes that answer HTML, templates, the frame, and error pages."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi import HTTPException as fastapi_HTTPException
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from sqlalchemy import func, select
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, RedirectResponse, Response

from amberbox.core.errors import AmberboxError
from amberbox.core.robot_status import SEVERITIES, highest
from amberbox.core.safe_text import escape_hidden
from amberbox.core.timestamps import format_time
from amberbox.core.version import __version__
from amberbox.diagnosis.report.wording import capitalize, readable, sentence
from amberbox.server.accounts.sessions import csrf_token
from amberbox.server.experiments import runs
from amberbox.server.experiments.runs import HOLDING, StoredRun
from amberbox.server.http import errors as api
from amberbox.server.http.auth import (
    FORM_TYPE,
    Decorator,
    Open,
    Routes,
    caller_of,
    services_of,
)
from amberbox.server.live.status import is_open
from amberbox.server.schema import ALARM, ALARM_ROBOT
from amberbox.server.services.context import Caller, Services
from amberbox.server.web import assets, text
from amberbox.server.web.text import catalogue, data_href, for_browser, mission_href, plain_cause


@dataclass(frozen=True, slots=True)
class OpenCount:
    """Number of open alarms that the caller may see, and the highest active severity."""

    count: int = 0
    severity: str = ""


def open_count(fleet: Services, who: Caller) -> OpenCount:
    """Count the open alarms that the caller may see."""
    every = who.principal.groups is None
    if every and not who.may("alarms.read"):
        return OpenCount()
    wanted = select(ALARM.c.severity, ALARM.c.active, func.count()).where(is_open())
    with fleet.database.reading() as connection:
        if not every:
            mine = [robot.id for robot in who.robots(connection, "alarms.read")]
            of = select(ALARM_ROBOT.c.alarm).where(ALARM_ROBOT.c.robot.in_(mine))
            wanted = wanted.where(ALARM.c.number.in_(of))
        rows = connection.execute(wanted.group_by(ALARM.c.severity, ALARM.c.active)).all()
    worst = highest(severity for severity, lasts, _ in rows if lasts)
    return OpenCount(sum(count for *_, count in rows), worst)


TEMPLATES = Path(__file__).parent / "templates"
THEMES = ("light", "dark")
_UNSAFE = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "'": "\\u0027"})


class PageRoutes(Routes):
    """The routes of pages: each names its action as those of the API do, and answers HTML."""

    def __init__(self) -> None:
        super().__init__("", prefix="")

    def get(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a page."""
        return super().get(
            path, action, each=each, include_in_schema=False, response_class=HTMLResponse, **more
        )

    def form(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a page that answers a plain form."""
        return super().form(
            path, action, each=each, include_in_schema=False, response_class=HTMLResponse, **more
        )


def render(request: Request, template: str, status: int = 200, **values: Any) -> Response:
    """Return the page of a template with ``values``.

    It contains the strings for browser modules (below ``js`` in the catalogue) of the parts in the
    template's path and in ``strings``.
    """
    known = _about(request, template, values.pop("strings", ()))
    text = environment().get_template(template).render({**known, **values})
    # pages are for one caller only: caches must revalidate them each time
    return HTMLResponse(text, status, {"Cache-Control": "private, no-cache"})


_PATH = re.compile(r"/(?![/\\])[^\x00-\x20\\\x7f]*")


def is_own_path(address: str) -> bool:
    """Return whether an address is a path of this server, so that it is safe to redirect to.

    Browsers drop tabs and line ends, and read a backslash as a slash.
    """
    return _PATH.fullmatch(address) is not None


def visitor(request: Request) -> Caller | None:
    """Return the caller; None on open pages without a session."""
    try:
        return caller_of(request)
    except fastapi_HTTPException:
        return None


@lru_cache
def environment() -> Environment:
    """Return the Jinja environment: it escapes all values, and undefined ones are errors."""
    made = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_shown,
    )  # fmt: skip
    made.globals.update(
        t=catalogue().text, asset=assets.address, version=__version__, severities=SEVERITIES,
        data_href=data_href, mission_href=mission_href,
    )  # fmt: skip
    made.filters.update(
        json=as_json, size=text.size, count=text.count, percent=text.percent,
        span=text.span, capital=capitalize, sentence=sentence,
        readable=readable, plain_cause=plain_cause,
    )  # fmt: skip
    made.globals["m"] = made.get_template("macros.html").module
    return made


def _shown(value: Any) -> Any:
    """Return a text with hidden characters made visible; markup is returned as it is."""
    return escape_hidden(value) if type(value) is str else value


def as_json(value: Any) -> Markup:
    """Return a value as JSON, for a script element or an attribute in single quotes."""
    return Markup(json.dumps(value, separators=(",", ":")).translate(_UNSAFE))


def _about(request: Request, template: str, also: tuple[str, ...]) -> Mapping[str, Any]:
    services = services_of(request)
    me = visitor(request)
    parts = template.removesuffix(".html").split("/")
    theme = request.cookies.get("theme", "")
    return {
        "me": me,
        "csrf": csrf_token(me.secret) if me and me.secret else "",
        "theme": theme if theme in THEMES else "",
        "path": request.url.path,
        "now": format_time(services.clock.wall_ns()),
        "site": services.settings.public_url,
        "held": _held(services),
        "demo": getattr(services, "demo", None),
        "open_alarms": lambda: open_count(services, me) if me else OpenCount(),
        "browser_strings": for_browser(("common", *parts, *also)),
    }


def _held(services: Services) -> Callable[[str], StoredRun | None]:
    """Return a function that finds the run that holds a robot; it reads them once."""

    @cache
    def all_held() -> Mapping[str, StoredRun]:
        with services.database.reading() as connection:
            return {run.robot: run for run in runs.listed(connection, states=HOLDING, limit=1000)}

    return lambda robot: all_held().get(robot)


_FIRST = ("base", "robot_base", "home", "robot/")
"""What templates begin with whose pages are looked at first."""


class Warming:
    """Compiles all templates, one after the other, when the server starts."""

    async def run(self) -> None:
        """Compile all templates; a request in the meantime compiles its own."""
        for name in await asyncio.to_thread(_names):
            await asyncio.to_thread(environment().get_template, name)

    def close(self) -> None:
        """Do nothing: it holds no resources."""


def _names() -> list[str]:
    return sorted(environment().list_templates(), key=lambda name: not name.startswith(_FIRST))


PROGRAMS = ("/api/v1/", "/link/", "/static/")
"""Paths of programs: errors are JSON there."""
_EXPLAINED = ("401", "403", "404", "429", "503")


def add_handlers(app: FastAPI) -> None:
    """Make an app answer errors as pages for browsers, as JSON for programs."""
    app.add_exception_handler(AmberboxError, _known)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(RequestValidationError, _invalid)


def is_page(request: Request) -> bool:
    """Return whether a request is for a page, not for JSON."""
    method = request.scope.get("method")  # WebSockets have none
    wants_json = request.headers.get("accept", "").startswith("application/json")
    is_form = request.headers.get("content-type", "").startswith(FORM_TYPE)
    by_browser = method == "GET" or (method == "POST" and is_form)
    return by_browser and not wants_json and not request.url.path.startswith(PROGRAMS)


async def _known(request: Request, found: Exception) -> Response:
    assert isinstance(found, AmberboxError)
    if not is_page(request):
        return await api.answer_known_error(request, found)
    return await run_in_threadpool(_page, request, api.status_of(found), found.what, found.hint)


async def _http(request: Request, found: Exception) -> Response:
    assert isinstance(found, HTTPException)
    if not is_page(request):
        return await api.answer_http_error(request, found)
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
        return await api.answer_invalid_request(request, found)
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
