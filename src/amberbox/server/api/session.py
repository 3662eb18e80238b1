"""Routes of one's own session: sign in and out, change the password, list and end sessions."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, HTTPException, Request, Response
from pydantic import Field

from amberbox.core.clock import NS
from amberbox.server.accounts import signin
from amberbox.server.accounts.permissions import Principal, Role
from amberbox.server.accounts.sessions import (
    LONGEST_NS,
    NewSession,
    csrf_token,
    end_session,
    revoke_session,
    revoke_sessions,
)
from amberbox.server.accounts.users import User, find_user
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import COOKIE, Fleet, Open, Routes, Who, address_of, is_own_page
from amberbox.server.http.errors import ErrorBody
from amberbox.server.http.forms import Form
from amberbox.server.services import people
from amberbox.server.services.context import Services
from amberbox.server.services.people import OwnSession

routes = Routes("session")

_MOST_PASSWORD = 1024
Text = Annotated[str, Field(min_length=1, max_length=_MOST_PASSWORD)]


class Login(Form):
    """Name and password."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    password: Text


class NewPassword(Form):
    """The password as it is, and as it shall be; whether all of one's tokens are revoked."""

    old: Text
    new: Text
    revoke_tokens: bool = False


@dataclass(frozen=True, slots=True)
class Myself:
    """Who asks; ``groups`` null is all robots, ``csrf`` what changes need in ``X-CSRF-Token``.

    With ``must_change`` nothing but a new password is allowed.
    """

    kind: Literal["user", "token", "robot"]
    name: str
    role: Role | None
    groups: list[str] | None
    must_change: bool
    csrf: str


@dataclass(frozen=True, slots=True)
class EndedSessions:
    """How many sessions were ended."""

    ended: int


def from_our_pages(request: Request, fleet: Fleet) -> None:
    """Refuse a request that a page of somebody else may have sent: no session guards it yet."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(415, "send JSON, with Content-Type: application/json")
    origin = request.headers.get("origin")
    if origin is not None and not is_own_page(origin, request, fleet.settings):
        raise HTTPException(403, "one signs in on pages of this server only")


@routes.post(
    "/session",
    Open("to sign in; checks name and password, and makes wrong ones wait"),
    responses={415: {"model": ErrorBody, "description": "not JSON"}},
)
async def begin(
    login: Login,
    request: Request,
    response: Response,
    fleet: Fleet,
    _: Annotated[None, Depends(from_our_pages)],
) -> Myself:
    """Sign in: the session is in a cookie that no script can read."""
    user, session = await fleet.passwords.apart(
        signin.sign_in, fleet.database, fleet.clock, fleet.passwords, login.name, login.password,
        came_from(request),
    )  # fmt: skip
    set_cookie(response, fleet, session)
    return myself(user.principal, session.secret)


@routes.get("/session", "own.read")
def read_session(who: Who) -> Myself:
    """Return who asks, and the token that changes need."""
    return myself(who.principal, who.secret)


@routes.delete("/session", "own.write", status_code=204)
def end(who: Who, fleet: Fleet) -> Response:
    """Sign out."""
    with fleet.database.begin() as connection:
        end_session(connection, who.secret)
        who.note(connection, fleet.clock.wall_ns(), "logout", who.principal.id)
    fleet.bus.publish(ServerChange("account", data={"name": who.principal.id}))
    response = Response(status_code=204)
    response.delete_cookie(COOKIE, secure=fleet.settings.is_secure, httponly=True, samesite="lax")
    return response


@routes.put("/session/password", "own.write")
async def change_password(
    passwords: NewPassword, request: Request, response: Response, who: Who, fleet: Fleet
) -> Myself:
    """Change one's password: all sessions end, and a new one begins here."""
    session = await fleet.passwords.apart(
        signin.change_password, fleet.database, fleet.clock, fleet.passwords, who.principal.id,
        passwords.old, passwords.new, came_from(request), with_tokens=passwords.revoke_tokens,
    )  # fmt: skip
    fleet.bus.publish(ServerChange("account", data={"name": who.principal.id}))
    set_cookie(response, fleet, session)
    user = await asyncio.to_thread(_user, fleet, who.principal.id)
    return myself(user.principal, session.secret)


@routes.get("/session/list", "own.read")
def list_own(who: Who, fleet: Fleet) -> list[OwnSession]:
    """Return one's open sessions, newest first."""
    return people.list_sessions(fleet, who)


@routes.delete("/session/list/{session_id}", "own.write", status_code=204)
def revoke(session_id: str, who: Who, fleet: Fleet) -> Response:
    """End one of one's sessions, for instance of a screen that was left open."""
    with fleet.database.begin() as connection:
        user = find_user(connection, who.principal.id)
        if not revoke_session(connection, user.user_id, session_id):
            raise HTTPException(404, "you have no such session")
        who.note(connection, fleet.clock.wall_ns(), "session.revoke", session_id)
    fleet.bus.publish(ServerChange("account", data={"name": who.principal.id}))
    return Response(status_code=204)


@routes.delete("/session/others", "own.write")
def revoke_others(who: Who, fleet: Fleet) -> EndedSessions:
    """End all of one's sessions but the one that asks."""
    with fleet.database.begin() as connection:
        user = find_user(connection, who.principal.id)
        count = revoke_sessions(connection, user.user_id, but=who.session_id)
        details = {"ended": count}
        who.note(connection, fleet.clock.wall_ns(), "session.revoke", "others", details=details)
    fleet.bus.publish(ServerChange("account", data={"name": who.principal.id}))
    return EndedSessions(count)


def _user(fleet: Services, name: str) -> User:
    with fleet.database.reading() as connection:
        return find_user(connection, name)


def came_from(request: Request) -> signin.LoginOrigin:
    """Return the origin of a login."""
    agent = request.headers.get("user-agent", "")
    return signin.LoginOrigin(address_of(request), agent, request.cookies.get(COOKIE))


def myself(who: Principal, secret: str) -> Myself:
    """Return the account of a session's user."""
    groups = None if who.groups is None else sorted(who.groups)
    csrf = csrf_token(secret) if secret else ""
    return Myself(who.kind, who.id, who.role, groups, who.must_change, csrf)


def set_cookie(response: Response, fleet: Services, session: NewSession) -> None:
    """Let the browser keep a session."""
    response.set_cookie(
        COOKIE, session.secret, max_age=LONGEST_NS // NS, path="/",
        secure=fleet.settings.is_secure, httponly=True, samesite="lax",
    )  # fmt: skip
