"""Routes that say what they are: every one names its action, and nobody gets past that.

A room of the API makes ``routes = Routes()`` and adds to it. ``who`` asks who it is: a session's
cookie, a token, or on the link a robot's key. What a request may do is decided by
``accounts.principal.allowed`` alone. A robot that somebody may not see is one that is not there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias, TypeVar

from fastapi import APIRouter, Depends, HTTPException, Path
from sqlalchemy import Connection
from starlette.requests import HTTPConnection

from amberbox.core.errors import UsageError
from amberbox.fleet.accounts.actions import ACTIONS
from amberbox.fleet.accounts.principal import Principal, Robot, UnknownActionError, allowed
from amberbox.fleet.accounts.robots import KnownRobot, find_robot, list_robots
from amberbox.fleet.api.errors import PROBLEMS
from amberbox.fleet.api.forms import ID
from amberbox.fleet.audit.entry import Entry, Result
from amberbox.fleet.audit.log import append
from amberbox.fleet.services import Services

PREFIX = "/api/v1"

Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks, from where; ``session_id`` and ``secret`` where it is by a session's cookie."""

    principal: Principal
    address: str
    agent: str = ""
    session_id: str = ""
    secret: str = field(default="", repr=False)

    @property
    def asker(self) -> str:
        """Return who takes turns with others: a person, whichever of their tokens asks."""
        return self.principal.owner or self.principal.id

    def may(self, action: str, robot: KnownRobot | Robot | None = None) -> bool:
        """Tell whether an action is allowed, to a robot or to all of them; robots: to itself."""
        seen = robot.robot if isinstance(robot, KnownRobot) else robot
        if seen is None and self.principal.kind == "robot":
            seen = Robot(self.principal.id)
        return allowed(self.principal, action, seen)

    def may_some(self, action: str) -> bool:
        """Tell whether an action is allowed to robots of one's groups, if there are any."""
        groups = self.principal.groups
        if groups is None:
            return self.may(action)
        return bool(groups) and self.may(action, Robot("", groups))

    def robots(self, connection: Connection, action: str = "status.read") -> list[KnownRobot]:
        """Return the robots to which an action is allowed, disabled ones too."""
        return [robot for robot in list_robots(connection) if self.may(action, robot)]

    def note(
        self, connection: Connection, now_ns: int, action: str, object: str = "",
        result: Result = "ok", details: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Add to the audit log, in the transaction of the change."""
        entry = Entry(str(self.principal), self.address, action, object, result, details or {})
        append(connection, now_ns, entry)


@dataclass(frozen=True, slots=True)
class Open:
    """Why a route asks nobody who it is: it shows nothing, or asks in its own way."""

    reason: str


@dataclass(frozen=True, slots=True)
class Rule:
    """What a route takes: an action, or a reason why it is open.

    With ``each`` it is about many robots: the route itself leaves out those the caller may not see.
    """

    action: str | Open
    each: bool = False


class Routes:
    """The routes of one room; ``router`` is what the app includes, ``rules`` what they take."""

    def __init__(self, tag: str = "", prefix: str = PREFIX) -> None:
        self.prefix = prefix
        tags: list[Any] = [tag] if tag else []
        self.router = APIRouter(tags=tags, prefix=prefix, responses=PROBLEMS)
        self.rules: dict[tuple[str, str], Rule] = {}

    def get(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that reads."""
        return self._add("GET", path, Rule(action, each), more)

    def post(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that changes something, or asks for what takes long."""
        return self._add("POST", path, Rule(action, each), more)

    def put(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that replaces something."""
        return self._add("PUT", path, Rule(action, each), more)

    def head(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that tells about something."""
        return self._add("HEAD", path, Rule(action, each), more)

    def patch(self, path: str, action: str | Open, *, each: bool = False, **more: Any) -> Decorator:
        """Add a route that changes a part of something."""
        return self._add("PATCH", path, Rule(action, each), more)

    def delete(
        self, path: str, action: str | Open, *, each: bool = False, **more: Any
    ) -> Decorator:
        """Add a route that removes something."""
        return self._add("DELETE", path, Rule(action, each), more)

    def socket(self, path: str, action: str | Open, *, each: bool = False) -> Decorator:
        """Add a WebSocket."""
        rule = self._enter("SOCKET", path, Rule(action, each))

        def add(endpoint: Endpoint) -> Endpoint:
            self.router.add_api_websocket_route(path, endpoint, dependencies=_guards(rule))
            return endpoint

        return add

    def _add(self, method: str, path: str, rule: Rule, more: Mapping[str, Any]) -> Decorator:
        self._enter(method, path, rule)

        def add(endpoint: Endpoint) -> Endpoint:
            self.router.add_api_route(
                path, endpoint, methods=[method], dependencies=_guards(rule), **more
            )
            return endpoint

        return add

    def _enter(self, method: str, path: str, rule: Rule) -> Rule:
        if isinstance(rule.action, str) and rule.action not in ACTIONS:
            raise UnknownActionError(f"{method} {path}: unknown action {rule.action!r}")
        self.rules[method, self.prefix + path] = rule
        return rule


Decorator: TypeAlias = "Callable[[Any], Any]"


def services_of(connection: HTTPConnection) -> Services:
    """Return the parts of the server that answers."""
    found: Services = connection.app.state.services
    return found


def caller_of(connection: HTTPConnection) -> Caller:
    """Return who asks; raises 401 for nobody. Found once per request."""
    from amberbox.fleet.api.who import identify

    found: Caller | None = getattr(connection.state, "caller", None)
    if found is None:
        found = connection.state.caller = identify(connection, services_of(connection))
    return found


def robot_of(connection: HTTPConnection, robot: Annotated[str, Path(pattern=ID)]) -> KnownRobot:
    """Return the robot that the path names; 404 also for one that the caller may not see."""
    found: KnownRobot = connection.state.robot
    return found


Fleet = Annotated[Services, Depends(services_of)]
Who = Annotated[Caller, Depends(caller_of)]
OfRobot = Annotated[KnownRobot, Depends(robot_of)]
"""Of a route with ``{robot}`` in its path, which the guard has looked up."""


def _guards(rule: Rule) -> list[Any]:
    return [] if isinstance(rule.action, Open) else [Depends(Guard(rule.action, rule.each))]


@dataclass(frozen=True, slots=True)
class Guard:
    """Lets a request through that may do an action, to the robot of its path if there is one."""

    action: str
    each: bool

    def __call__(self, connection: HTTPConnection) -> None:
        """Raise 401, 403 or 404 for a request that may not."""
        caller = caller_of(connection)
        name = connection.path_params.get("robot")
        if name is not None:
            connection.state.robot = self._robot(connection, caller, str(name))
        elif not (caller.may_some(self.action) if self.each else caller.may(self.action)):
            raise HTTPException(403, f"{caller.principal.role or caller.principal.kind} may not")

    def _robot(self, connection: HTTPConnection, caller: Caller, name: str) -> KnownRobot:
        """Look a robot up; whoever may not even see it learns nothing of it."""
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
