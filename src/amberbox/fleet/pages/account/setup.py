"""The first start: a page that makes the first admin, and is gone when there is one."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from functools import partial
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
from amberbox.fleet.api.access import Fleet, Open
from amberbox.fleet.api.errors import status_of
from amberbox.fleet.api.origins import is_own_page
from amberbox.fleet.api.who import address_of, is_here
from amberbox.fleet.bus import Change
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.services import Services

routes = Pages()

_WHY = Open("makes the first admin, for who is on the machine or has its code; 404 afterwards")
_MOST = 10_000


@routes.get("/setup", _WHY)
def ask(request: Request, fleet: Fleet) -> Response:
    """Show the form."""
    return _page(request, fleet, **_situation(request, fleet))


@routes.post("/setup", _WHY, include_in_schema=False, response_class=HTMLResponse)
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
        said = {**known, "problem": error.what, "hint": error.hint}
        answer = await asyncio.to_thread(_page, request, fleet, status_of(error), **said)
        if isinstance(error, MustWaitError):
            answer.headers["Retry-After"] = str(error.seconds)
        return answer
    fleet.bus.publish(Change("account", data={"name": name}))
    return await asyncio.to_thread(_page, request, fleet, made=name)


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
