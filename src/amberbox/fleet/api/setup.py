"""The first start: a page that makes the first admin, and is gone when there is one."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from fastapi import HTTPException, Request, Response
from fastapi.responses import HTMLResponse

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.fleet.accounts.setupcode import (
    code_waits,
    needs_setup,
    set_up_here,
    use_setup_code,
)
from amberbox.fleet.accounts.signin import Caller, MustWaitError
from amberbox.fleet.api.access import Fleet, Open, Routes
from amberbox.fleet.api.errors import status_of
from amberbox.fleet.api.origins import is_own_page
from amberbox.fleet.api.who import address_of
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services
from amberbox.fleet.serving.forwarded import is_loopback

routes = Routes("setup", prefix="")

_WHY = Open("makes the first admin, for who is on the machine or has its code; 404 afterwards")
_PAGES = Path(__file__).parent.parent / "serving" / "pages"
_MOST = 10_000
_ASKS: dict[str, Any] = {"include_in_schema": False, "response_class": HTMLResponse}


@routes.get("/setup", _WHY, **_ASKS)
def ask(request: Request, fleet: Fleet) -> Response:
    """Show the form."""
    return _page(fleet, **_situation(request, fleet))


@routes.post("/setup", _WHY, **_ASKS)
async def make(request: Request, fleet: Fleet) -> Response:
    """Make the admin; what is wrong is said on the page."""
    situation = await asyncio.to_thread(_situation, request, fleet)
    origin = request.headers.get("origin")
    if origin is not None and not is_own_page(origin, request, fleet.settings):
        raise HTTPException(403, "the form is on a page of this server only")
    form = await _form(request)
    name, known = form.get("name", ""), {**situation, "name": form.get("name", "")}
    try:
        await _made(request, fleet, form, needs_code=situation["needs_code"])
    except AmberboxError as error:
        wait = {"Retry-After": str(error.seconds)} if isinstance(error, MustWaitError) else None
        return _page(fleet, status_of(error), wait, **known, problem=error.what, hint=error.hint)
    fleet.bus.publish(Change("account", data={"name": name}))
    return _page(fleet, made=name)


@routes.get("/setup/style.css", Open("how the page looks"), include_in_schema=False)
def style() -> Response:
    """Return the style of the page."""
    return Response((_PAGES / "setup.css").read_bytes(), media_type="text/css")


async def _made(
    request: Request, fleet: Services, form: Mapping[str, str], *, needs_code: bool
) -> None:
    name, password = form.get("name", ""), form.get("password", "")
    if password != form.get("again", ""):
        raise UsageError("the passwords differ", "type the same one twice")
    caller = Caller(address_of(request), request.headers.get("user-agent", ""))
    base = fleet.database, fleet.clock, fleet.passwords, fleet.folder
    if needs_code:
        work = partial(use_setup_code, *base, form.get("code", ""), name, password, caller)
    else:
        work = partial(set_up_here, *base, name, password, caller)
    await fleet.passwords.apart(work)


def _situation(request: Request, fleet: Services) -> dict[str, Any]:
    """Return what the page depends on; raises 404 when nobody is to be made an admin here."""
    with fleet.database.reading() as connection:
        is_first = needs_setup(connection)
        waits = code_waits(connection, fleet.clock.wall_ns())
    if not is_first and not waits:
        raise HTTPException(404, "this server is set up")
    return {"is_first": is_first, "needs_code": not (is_first and is_here(request, fleet))}


def is_here(request: Request, fleet: Services) -> bool:
    """Tell whether somebody on the machine asks: behind a proxy nobody can know."""
    peer = request.client.host if request.client else ""
    by_proxy = any(name in request.headers for name in ("x-forwarded-for", "forwarded", "via"))
    return is_loopback(peer) and not fleet.settings.proxies and not by_proxy


async def _form(request: Request) -> dict[str, str]:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    body = await request.body()
    if kind != "application/x-www-form-urlencoded" or len(body) > _MOST:
        raise HTTPException(415, "send the form of the page")
    found = parse_qs(body.decode("utf-8", "replace"), keep_blank_values=True, max_num_fields=10)
    return {name: values[-1] for name, values in found.items()}


def _page(
    fleet: Services, status: int = 200, headers: Mapping[str, str] | None = None, **about: Any
) -> Response:
    text = _template().render(folder=fleet.folder, **about)
    return HTMLResponse(text, status, headers)


@lru_cache
def _template() -> Any:
    from jinja2 import Environment, FileSystemLoader

    return Environment(loader=FileSystemLoader(_PAGES), autoescape=True).get_template("setup.html")
