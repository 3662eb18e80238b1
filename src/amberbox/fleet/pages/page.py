"""What every page is made with: routes that answer HTML, and the frame around each page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from fastapi import HTTPException, Request
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from starlette.responses import HTMLResponse, Response

from amberbox import __version__
from amberbox.core.showing import visible
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts.sessions import csrf_token
from amberbox.fleet.api.access import Caller, Decorator, Open, Routes, caller_of, services_of
from amberbox.fleet.pages import assets, figures, wording
from amberbox.fleet.pages.alarms.count import OpenCount, open_count
from amberbox.fleet.pages.alarms.wording import plain_cause
from amberbox.fleet.pages.datalinks import data_href, mission_href
from amberbox.fleet.pages.strings import catalogue, for_browser
from amberbox.monitoring.engine.outputs import SEVERITIES

TEMPLATES = Path(__file__).parent / "templates"
THEMES = ("light", "dark")
_UNSAFE = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "'": "\\u0027"})


class Pages(Routes):
    """The routes of one page: they name their action as those of the API do, and answer HTML."""

    def __init__(self) -> None:
        super().__init__("", prefix="")

    def get(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a page."""
        return super().get(
            path, action, each=each, include_in_schema=False, response_class=HTMLResponse, **more
        )


def render(request: Request, template: str, status: int = 200, **values: Any) -> Response:
    """Make a page of a template; ``values`` are what it shows.

    The browser gets the strings below ``js`` of the parts of the catalogue that the template's
    path and ``strings`` name.
    """
    known = _about(request, template, values.pop("strings", ()))
    text = environment().get_template(template).render({**known, **values})
    # a page shows what only who is signed in may see: it is asked for again each time
    return HTMLResponse(text, status, {"Cache-Control": "private, no-cache"})


def visitor(request: Request) -> Caller | None:
    """Return who asks; None for nobody, on pages that are open."""
    try:
        return caller_of(request)
    except HTTPException:
        return None


@lru_cache
def environment() -> Environment:
    """Return what makes pages of templates: everything is escaped, nothing may be missing."""
    made = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, finalize=_shown,
    )  # fmt: skip
    made.globals.update(
        t=catalogue().text, asset=assets.address, version=__version__, severities=SEVERITIES,
        data_href=data_href, mission_href=mission_href,
    )  # fmt: skip
    made.filters.update(
        json=as_json, size=figures.size, count=figures.count, percent=figures.percent,
        span=figures.span, capital=wording.capital, sentence=wording.sentence,
        readable=wording.readable, plain_cause=plain_cause,
    )  # fmt: skip
    made.globals["m"] = made.get_template("macros.html").module
    return made


def _shown(value: Any) -> Any:
    """Write out what a text hides; what was escaped before was shown before."""
    return visible(value) if type(value) is str else value


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
        "demo": getattr(services, "demo", None),
        "open_alarms": lambda: open_count(services, me) if me else OpenCount(),
        "browser_strings": for_browser(("common", *parts, *also)),
    }
