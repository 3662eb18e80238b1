"""Authentication and authorisation of routes: each names its action, which a guard enforces.

People are identified by a session's cookie, programs by a token, robots by their key.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, TypeVar
from urllib.parse import urlsplit

from fastapi import APIRouter, Depends, HTTPException, Path
from starlette.datastructures import QueryParams
from starlette.requests import HTTPConnection, Request

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.server.accounts.permissions import ACTIONS, UnknownActionError
from amberbox.server.accounts.robots import (
    KnownRobot,
    find_robot,
    find_robot_key,
    read_authorization,
    touch_key,
)
from amberbox.server.accounts.sessions import (
    find_session,
    is_csrf_token,
    needs_touch,
    touch_session,
)
from amberbox.server.accounts.tokens import find_token, touch_token
from amberbox.server.config import ServerSettings, client_address, is_local, is_loopback
from amberbox.server.http.errors import PROBLEMS
from amberbox.server.http.forms import ID
from amberbox.server.services.context import Caller, Demonstration, Services

PREFIX = "/api/v1"

Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Open:
    """The reason why a route needs no authentication, such as that it shows nothing."""

    reason: str


@dataclass(frozen=True, slots=True)
class RouteRule:
    """The requirement of a route: an action, or a reason why it is open.

    With ``each`` it concerns many robots: the route itself leaves out those the caller may not see.
    """

    action: str | Open
    each: bool = False


class Routes:
    """The routes of one module: ``router`` for the app, and ``rules`` by method and path."""

    def __init__(self, tag: str = "", prefix: str = PREFIX) -> None:
        self.prefix = prefix
        tags: list[Any] = [tag] if tag else []
        self.router = APIRouter(tags=tags, prefix=prefix, responses=PROBLEMS)
        self.rules: dict[tuple[str, str], RouteRule] = {}

    def get(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that reads."""
        return self._add("GET", path, RouteRule(action, each), more)

    def post(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that changes something, or starts a long computation."""
        return self._add("POST", path, RouteRule(action, each), more)

    def put(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that replaces something."""
        return self._add("PUT", path, RouteRule(action, each), more)

    def head(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a HEAD route."""
        return self._add("HEAD", path, RouteRule(action, each), more)

    def patch(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that changes a part of something."""
        return self._add("PATCH", path, RouteRule(action, each), more)

    def delete(
        self, path: str, action: str | Open, *, each: bool = False, **more: Any
    ) -> Decorator:
        """Add a route that removes something."""
        return self._add("DELETE", path, RouteRule(action, each), more)

    def socket(self, path: str, action: str | Open, *, each: bool = False) -> Decorator:
        """Add a WebSocket route."""
        rule = self._enter("SOCKET", path, RouteRule(action, each))

        def add(endpoint: Endpoint) -> Endpoint:
            self.router.add_api_websocket_route(path, endpoint, dependencies=_guards(rule))
            return endpoint

        return add

    def form(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route for plain forms, which work without scripts: ``Fields`` are theirs.

        The CSRF token of the session is in the field ``csrf``.
        """
        return self._add("POST", path, RouteRule(action, each), more, (Depends(_read_fields),))

    def _add(
        self, method: str, path: str, rule: RouteRule, more: Mapping[str, Any],
        before: Sequence[Any] = (),
    ) -> Decorator:  # fmt: skip
        self._enter(method, path, rule)

        def add(endpoint: Endpoint) -> Endpoint:
            dependencies = [*before, *_guards(rule)]
            self.router.add_api_route(
                path, endpoint, methods=[method], dependencies=dependencies, **more
            )
            return endpoint

        return add

    def _enter(self, method: str, path: str, rule: RouteRule) -> RouteRule:
        if isinstance(rule.action, str) and rule.action not in ACTIONS:
            raise UnknownActionError(f"{method} {path}: unknown action {rule.action!r}")
        self.rules[method, self.prefix + path] = rule
        return rule


Decorator: TypeAlias = "Callable[[Any], Any]"


def services_of(connection: HTTPConnection) -> Services:
    """Return the services of the server that handles the request."""
    found: Services = connection.app.state.services
    return found


def caller_of(connection: HTTPConnection) -> Caller:
    """Return the authenticated caller, found once per request; raises 401 without one."""

    found: Caller | None = getattr(connection.state, "caller", None)
    if found is None:
        found = connection.state.caller = identify(connection, services_of(connection))
    return found


def robot_of(connection: HTTPConnection, robot: Annotated[str, Path(pattern=ID)]) -> KnownRobot:
    """Return the robot in the path, which the guard has looked up and checked."""
    found: KnownRobot = connection.state.robot
    return found


Fleet = Annotated[Services, Depends(services_of)]
Who = Annotated[Caller, Depends(caller_of)]
OfRobot = Annotated[KnownRobot, Depends(robot_of)]
"""Of a route with ``{robot}`` in its path, which the guard has looked up."""


FORM_TYPE = "application/x-www-form-urlencoded"
_MOST_FIELDS = 300


async def _read_fields(request: Request) -> None:
    """Read the fields of a plain form, for the guard and for ``Fields``."""
    if request.headers.get("content-type", "").startswith(FORM_TYPE):
        body = await request.body()
        if body.count(b"&") >= _MOST_FIELDS:
            raise HTTPException(400, f"a form has at most {_MOST_FIELDS} fields")
        request.state.fields = QueryParams(body.decode("utf-8", "replace"))


def _fields_of(connection: HTTPConnection) -> QueryParams:
    found: QueryParams = getattr(connection.state, "fields", QueryParams())
    return found


Fields = Annotated[QueryParams, Depends(_fields_of)]
"""The fields of a plain form, by name; of ``Routes.form``."""


def _guards(rule: RouteRule) -> list[Any]:
    return [] if isinstance(rule.action, Open) else [Depends(Guard(rule.action, rule.each))]


@dataclass(frozen=True, slots=True)
class Guard:
    """A dependency that lets a request pass if its caller may do an action.

    If the path names a robot, the caller must be allowed to do it on that robot.
    """

    action: str
    each: bool

    def __call__(self, connection: HTTPConnection) -> None:
        """Raise 401, 403 or 404 for a request that is not allowed."""
        caller = caller_of(connection)
        name = connection.path_params.get("robot")
        if name is not None:
            connection.state.robot = self._robot(connection, caller, str(name))
        elif not (caller.may_some(self.action) if self.each else caller.may(self.action)):
            raise HTTPException(403, f"{caller.principal.role or caller.principal.kind} may not")

    def _robot(self, connection: HTTPConnection, caller: Caller, name: str) -> KnownRobot:
        """Return a robot; raises the same 404 for an unknown one and one the caller may not see."""
        with services_of(connection).database.reading() as transaction:
            try:
                robot = find_robot(transaction, name)
            except UsageError:
                robot = None
        if robot is None or not (
            caller.may(self.action, robot) or caller.may("status.read", robot)
        ):
            raise HTTPException(404, "there is no such robot, or not for you")
        if not caller.may(self.action, robot):
            raise HTTPException(403, f"{caller.principal.role or caller.principal.kind} may not")
        return robot


_PORTS = {"https": 443, "http": 80}


def is_own_page(origin: str, connection: HTTPConnection, settings: ServerSettings) -> bool:
    """Return whether an origin is that of this server's pages.

    That is its public address or, on the machine itself and without proxies, the local name of the
    request.
    """
    asked = _parts(origin)
    if asked == _parts(settings.public_url):
        return True
    here = f"{asked[0]}://{connection.headers.get('host', '')}"
    scheme = "https" if settings.certificate is not None else "http"
    is_here = asked == _parts(here) and asked[0] == scheme and is_local(asked[1])
    return is_here and not settings.proxies


def _parts(url: str) -> tuple[str, str, int | None]:
    try:
        parts = urlsplit(url)
        return parts.scheme, parts.hostname or "", parts.port or _PORTS.get(parts.scheme)
    except ValueError:
        return "", url, None


COOKIE = "amberbox_session"
CSRF_HEADER = "x-csrf-token"
CSRF_FIELD = "csrf"
_READS = ("GET", "HEAD", "OPTIONS")
_BEARER = "bearer "


def identify(connection: HTTPConnection, services: Services) -> Caller:
    """Authenticate a request; raises 401 without credentials, 403 for one from a foreign page.

    A header ``Authorization`` takes precedence; a cookie is then ignored.
    """
    header = connection.headers.get("authorization", "")
    if connection.scope["type"] == "websocket":
        _check_origin(connection, services, has_header=bool(header))
    if header:
        return _by_header(connection, services, header)
    return _by_cookie(connection, services)


def address_of(connection: HTTPConnection) -> str:
    """Return the address of the client; behind a trusted proxy the forwarded one."""
    peer = connection.client.host if connection.client else ""
    proxies = services_of(connection).settings.proxies
    if not proxies:
        return peer
    return client_address(peer, connection.headers.getlist("x-forwarded-for"), proxies)


def is_here(connection: HTTPConnection) -> bool:
    """Return whether the request comes from this machine; False behind any proxy."""
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
    """Return whether to store a use: at most once a minute, because writers queue."""
    return used_ns is None or now_ns - used_ns >= 60 * NS


def _by_cookie(connection: HTTPConnection, services: Services) -> Caller:
    secret, now_ns = connection.cookies.get(COOKIE, ""), services.clock.wall_ns()
    with services.database.reading() as reading:
        found = find_session(reading, now_ns, secret)
    if found is None:
        raise HTTPException(401, "sign in first")
    changes = connection.scope["type"] == "http" and connection.scope["method"] not in _READS
    if changes and not is_csrf_token(secret, _sent_token(connection)):
        raise HTTPException(403, f"a change needs the header {CSRF_HEADER} of this session")
    if needs_touch(found.session, now_ns):
        with services.database.begin() as writing:
            touch_session(writing, now_ns, found.session.session_id)
    agent = connection.headers.get("user-agent", "")
    who = found.user.principal
    return Caller(who, address_of(connection), agent, found.session.session_id, secret)


def _sent_token(connection: HTTPConnection) -> str:
    """Return the CSRF token of a request: from its header, or a field of its plain form."""
    return connection.headers.get(CSRF_HEADER, "") or _fields_of(connection).get(CSRF_FIELD, "")


def _check_origin(connection: HTTPConnection, services: Services, *, has_header: bool) -> None:
    """Raise 403 for a WebSocket from a foreign page, which browsers reveal by ``Origin``."""
    origin = connection.headers.get("origin")
    if has_header:
        if origin is not None or COOKIE in connection.cookies:
            raise HTTPException(403, "a socket with a key has neither Origin nor cookie")
    elif origin is None or not is_own_page(origin, connection, services.settings):
        raise HTTPException(403, "this socket is for pages of this server")


def demonstration_of(fleet: Fleet) -> Demonstration:
    """Return the demonstration that the server belongs to; raises 404 if there is none."""
    if fleet.demo is None:
        raise HTTPException(404, "this server is no demonstration")
    return fleet.demo


InDemo = Annotated[Demonstration, Depends(demonstration_of)]
