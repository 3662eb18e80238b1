"""Sign in by a one-time link: in a demonstration only, and from the machine itself only."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import Depends, HTTPException, Request, Response
from pydantic import Field

from amberbox.fleet.accounts.signincodes import LONGEST, sign_in_by_code
from amberbox.fleet.api.access import Fleet, Open, Routes
from amberbox.fleet.api.demo import InDemo, demonstration_of
from amberbox.fleet.api.forms import Form
from amberbox.fleet.api.session import (
    Myself,
    came_from,
    from_our_pages,
    myself,
    set_cookie,
)
from amberbox.fleet.api.who import is_here

routes = Routes("session")


class Code(Form):
    """What stands behind the ``#`` of the link."""

    code: Annotated[str, Field(min_length=1, max_length=LONGEST)]


def from_here(request: Request, fleet: Fleet) -> None:
    """Refuse who is not on the machine itself; where no demonstration runs, everybody."""
    demonstration_of(fleet)
    if not is_here(request):
        raise HTTPException(403, "these links are for who is on the machine itself")


@routes.post(
    "/session/code",
    Open("to sign in by a one-time link, in a demonstration; 404 anywhere else"),
)
async def begin_by_code(
    _here: Annotated[None, Depends(from_here)],
    _ours: Annotated[None, Depends(from_our_pages)],
    code: Code,
    request: Request,
    response: Response,
    fleet: Fleet,
    demo: InDemo,
) -> Myself:
    """Sign in with a code, which is used up: the session is in a cookie, as after any login."""
    user, session = await asyncio.to_thread(
        sign_in_by_code, fleet.database, fleet.clock, demo.codes, code.code, came_from(request)
    )
    set_cookie(response, fleet, session)
    return myself(user.principal, session.secret)
