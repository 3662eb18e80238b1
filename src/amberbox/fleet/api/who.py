"""Who sends a request: a person by the session's cookie, a program by its token, a robot."""

from __future__ import annotations

from fastapi import HTTPException
from starlette.requests import HTTPConnection

from amberbox.core.clock import NS
from amberbox.fleet.accounts.robotkeys import find_robot_key, read_authorization, touch_key
from amberbox.fleet.accounts.sessions import (
    find_session,
    is_csrf_token,
    needs_touch,
    touch_session,
)
from amberbox.fleet.accounts.tokens import find_token, touch_token
from amberbox.fleet.api.access import Caller, services_of
from amberbox.fleet.api.origins import is_own_page
from amberbox.fleet.services import Services
from amberbox.fleet.serving.forwarded import client_address, is_loopback

COOKIE = "amberbox_session"
CSRF_HEADER = "x-csrf-token"
_READS = ("GET", "HEAD", "OPTIONS")
_BEARER = "bearer "


def identify(connection: HTTPConnection, services: Services) -> Caller:
    """Return who asks; raises 401 for nobody, 403 for a request that another page has made.

    A header ``Authorization`` decides alone; a cookie that comes along does not count then.
    """
    header = connection.headers.get("authorization", "")
    if connection.scope["type"] == "websocket":
        _check_origin(connection, services, has_header=bool(header))
    if header:
        return _by_header(connection, services, header)
    return _by_cookie(connection, services)


def address_of(connection: HTTPConnection) -> str:
    """Return where a request comes from: behind a proxy that is trusted, what that one says."""
    peer = connection.client.host if connection.client else ""
    proxies = services_of(connection).settings.proxies
    if not proxies:
        return peer
    return client_address(peer, connection.headers.getlist("x-forwarded-for"), proxies)


def is_here(connection: HTTPConnection) -> bool:
    """Tell whether somebody on the machine asks: behind a proxy nobody can know."""
    peer = connection.client.host if connection.client else ""
    by_proxy = any(name in connection.headers for name in ("x-forwarded-for", "forwarded", "via"))
    return is_loopback(peer) and not services_of(connection).settings.proxies and not by_proxy


def _by_header(connection: HTTPConnection, services: Services, header: str) -> Caller:
    now_ns, address = services.clock.wall_ns(), address_of(connection)
    if header[: len(_BEARER)].lower() == _BEARER:
        with services.database.reading() as reading:
            use = find_token(reading, now_ns, header[len(_BEARER) :].strip())
        if use is not None:
            if is_minute_old(use.token.used_ns, now_ns):
                with services.database.begin() as writing:
                    touch_token(writing, now_ns, use.token)
            return Caller(use.principal, address)
    elif (claim := read_authorization(header)) is not None:
        with services.database.reading() as reading:
            robot = find_robot_key(reading, now_ns, *claim)
        if robot is not None:
            if is_minute_old(robot.key.used_ns, now_ns):
                key = robot.key
                services.links.write(lambda writing: touch_key(writing, now_ns, key))
            return Caller(robot.principal, address, session_id=robot.key.key_id)
    raise HTTPException(401, "this key or token is unknown, or does not work any more")


def is_minute_old(used_ns: int | None, now_ns: int) -> bool:
    """Tell whether a use should be noted: not each, or every request would wait for writers."""
    return used_ns is None or now_ns - used_ns >= 60 * NS


def _by_cookie(connection: HTTPConnection, services: Services) -> Caller:
    secret, now_ns = connection.cookies.get(COOKIE, ""), services.clock.wall_ns()
    with services.database.reading() as reading:
        found = find_session(reading, now_ns, secret)
    if found is None:
        raise HTTPException(401, "sign in first")
    changes = connection.scope["type"] == "http" and connection.scope["method"] not in _READS
    if changes and not is_csrf_token(secret, connection.headers.get(CSRF_HEADER, "")):
        raise HTTPException(403, f"a change needs the header {CSRF_HEADER} of this session")
    if needs_touch(found.session, now_ns):
        with services.database.begin() as writing:
            touch_session(writing, now_ns, found.session.session_id)
    agent = connection.headers.get("user-agent", "")
    who = found.user.principal
    return Caller(who, address_of(connection), agent, found.session.session_id, secret)


def _check_origin(connection: HTTPConnection, services: Services, *, has_header: bool) -> None:
    """Keep pages of others out: browsers name the page's origin, and cannot set the header."""
    origin = connection.headers.get("origin")
    if has_header:
        if origin is not None or COOKIE in connection.cookies:
            raise HTTPException(403, "a socket with a key has neither Origin nor cookie")
    elif origin is None or not is_own_page(origin, connection, services.settings):
        raise HTTPException(403, "this socket is for pages of this server")
