"""Pages for signing in, for adding the first admin, and of one's own account."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import parse_qs

from fastapi import HTTPException, Request, Response
from fastapi.responses import HTMLResponse
from starlette.responses import RedirectResponse

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.accounts.permissions import SCOPES
from amberbox.server.accounts.robots import list_groups
from amberbox.server.accounts.signin import (
    LoginOrigin,
    MustWaitError,
    code_waits,
    needs_setup,
    set_up_here,
    use_setup_code,
)
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import Fleet, InDemo, Open, Who, address_of, is_here, is_own_page
from amberbox.server.http.errors import status_of
from amberbox.server.services.context import Services
from amberbox.server.services.people import list_sessions, list_tokens
from amberbox.server.web.page import PageRoutes, is_own_path, render, visitor
from amberbox.server.web.text import catalogue

_BROWSERS = (
    ("Edg", "Edge"), ("OPR", "Opera"), ("SamsungBrowser", "Samsung Internet"),
    ("Firefox", "Firefox"), ("FxiOS", "Firefox"), ("Chromium", "Chromium"),
    ("HeadlessChrome", "Chrome"), ("CriOS", "Chrome"), ("Chrome", "Chrome"), ("Safari", "Safari"),
)  # fmt: skip
"""Products by their mark, those first whose line also has the marks of later ones."""
_SYSTEMS = (
    ("Android", "Android"), ("iPhone", "iPhone"), ("iPad", "iPad"), ("CrOS", "ChromeOS"),
    ("Windows", "Windows"), ("Mac OS X", "macOS"), ("Linux", "Linux"),
)  # fmt: skip
_PROGRAM = re.compile(r"[\w.+-]{1,40}")


def device(agent: str) -> str:
    """Return browser and system of a ``User-Agent``, or the name of a program."""
    text = catalogue().text
    browser, system = _first(_BROWSERS, agent, "/"), _first(_SYSTEMS, agent)
    if browser and system:
        return text("account.sessions.device", browser=browser, system=system)
    program = _PROGRAM.match(agent)
    return browser or (program[0] if program else text("account.sessions.unknown"))


def _first(known: Sequence[tuple[str, str]], agent: str, end: str = "") -> str:
    return next((name for mark, name in known if mark + end in agent), "")


routes = PageRoutes()


@routes.get("/account", "own.read")
def show_account(request: Request, fleet: Fleet, who: Who) -> Response:
    """Show one's own account; only the password form if the password has to be changed first."""
    more = {} if who.principal.must_change else _more(fleet, who)
    return render(request, "account/account.html", strings=("commands",), **more)


def _more(fleet: Services, who: Who) -> Mapping[str, Any]:
    mine = who.principal.groups
    with fleet.database.reading() as connection:
        teams = list_groups(connection) if mine is None else sorted(mine)
    tokens = [token for token in list_tokens(fleet, who.principal.id) if token.revoked is None]
    return {"sessions": list_sessions(fleet, who), "tokens": tokens, "scopes": SCOPES,
            "teams": teams, "device": device, "server_id": fleet.links.server_id}  # fmt: skip


@routes.get("/sign-in", Open("asks for name and password; shows nothing"))
def show_signin(request: Request, next: str = "/") -> Response:
    """Show the sign-in form; redirect a person who is signed in to the page ``next``."""
    onward = next if is_own_path(next) else "/"
    if visitor(request) is not None:
        return RedirectResponse(onward, 303)
    return render(request, "account/signin.html", onward=onward)


@routes.get("/in", Open("signs in by a link, in a demonstration; 404 anywhere else"))
def show_code(request: Request, demo: InDemo) -> Response:
    """Show the page that signs in by a code; the code itself is not sent to this route."""
    return render(request, "account/in.html")


_WHY = Open("makes the first admin, for who is on the machine or has its code; 404 afterwards")
_MOST = 10_000


@routes.get("/setup", _WHY)
def ask(request: Request, fleet: Fleet) -> Response:
    """Show the setup form."""
    return _page(request, fleet, **_situation(request, fleet))


@routes.post("/setup", _WHY, include_in_schema=False, response_class=HTMLResponse)
async def make(request: Request, fleet: Fleet) -> Response:
    """Add the first admin; errors are shown on the page."""
    situation = await asyncio.to_thread(_situation, request, fleet)
    origin = request.headers.get("origin")
    if origin is not None and not is_own_page(origin, request, fleet.settings):
        raise HTTPException(403, "the form is on a page of this server only")
    form = await _form(request)
    name, known = form.get("name", ""), {**situation, "name": form.get("name", "")}
    try:
        await _made(request, fleet, form, needs_code=situation["needs_code"])
    except AmberboxError as error:
        shown = {**known, "problem": error.what, "hint": error.hint}
        answer = await asyncio.to_thread(_page, request, fleet, status_of(error), **shown)
        if isinstance(error, MustWaitError):
            answer.headers["Retry-After"] = str(error.seconds)
        return answer
    fleet.bus.publish(ServerChange("account", data={"name": name}))
    return await asyncio.to_thread(_page, request, fleet, made=name)


async def _made(
    request: Request, fleet: Services, form: Mapping[str, str], *, needs_code: bool
) -> None:
    name, password = form.get("name", ""), form.get("password", "")
    if password != form.get("again", ""):
        raise UsageError("the passwords differ", "type the same one twice")
    caller = LoginOrigin(address_of(request), request.headers.get("user-agent", ""))
    base = fleet.database, fleet.clock, fleet.passwords, fleet.folder
    if needs_code:
        work = partial(use_setup_code, *base, form.get("code", ""), name, password, caller)
    else:
        work = partial(set_up_here, *base, name, password, caller)
    await fleet.passwords.apart(work)


def _situation(request: Request, fleet: Services) -> dict[str, Any]:
    """Return the state of the setup; raises 404 when no admin can be added here."""
    with fleet.database.reading() as connection:
        is_first = needs_setup(connection)
        waits = code_waits(connection, fleet.clock.wall_ns())
    if not is_first and not waits:
        raise HTTPException(404, "this server is set up")
    return {"is_first": is_first, "needs_code": not (is_first and is_here(request))}


async def _form(request: Request) -> dict[str, str]:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    body = await request.body()
    if kind != "application/x-www-form-urlencoded" or len(body) > _MOST:
        raise HTTPException(415, "send the form of the page")
    found = parse_qs(body.decode("utf-8", "replace"), keep_blank_values=True, max_num_fields=10)
    return {name: values[-1] for name, values in found.items()}


def _page(request: Request, fleet: Services, status: int = 200, **about: Any) -> Response:
    nothing = {"made": "", "problem": "", "hint": "", "name": "", "is_first": True,
               "needs_code": False}  # fmt: skip
    return render(
        request, "account/setup.html", status, folder=fleet.folder, **{**nothing, **about}
    )
