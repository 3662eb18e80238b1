"""Who listens, and what they may hear: asked again as long as they listen."""

from __future__ import annotations

from dataclasses import dataclass, field

from sqlalchemy import Connection

from amberbox.core.clock import Clock
from amberbox.fleet.accounts.principal import Principal, Robot, allowed
from amberbox.fleet.accounts.robots import list_robots
from amberbox.fleet.accounts.sessions import find_session
from amberbox.fleet.accounts.tokens import find_token
from amberbox.fleet.database.database import Database

ACTION = "status.read"
_NEEDS = {
    "presence": ACTION,
    "status": ACTION,
    "levels": ACTION,
    "ages": ACTION,
    "event": "items.read",
    "diagnosis": "diagnoses.read",
    "alarm": "alarms.read",
    "job": "data.download",
    "fetch": "data.query",
}
"""What each kind of change takes."""


@dataclass(frozen=True, slots=True)
class Credential:
    """What somebody came with: a session's cookie, or a token."""

    session: str = field(default="", repr=False)
    token: str = field(default="", repr=False)


@dataclass(frozen=True, slots=True)
class Permission:
    """What somebody may hear of: robots, and kinds of change for each."""

    principal: Principal
    kinds: dict[str, frozenset[str]]
    may_listen: bool = True

    @property
    def robots(self) -> frozenset[str]:
        """The robots that may be seen."""
        return self.kinds.get("status", frozenset())


def permission(database: Database, clock: Clock, credential: Credential) -> Permission | None:
    """Return what a credential allows now; None when it works no more."""
    with database.reading() as connection:
        principal = _principal(connection, clock.wall_ns(), credential)
        if principal is None:
            return None
        robots = list_robots(connection)
    kinds = {
        kind: frozenset(robot.id for robot in robots if allowed(principal, action, robot.robot))
        for kind, action in _NEEDS.items()
    }
    some = Robot("", principal.groups or frozenset())
    return Permission(principal, kinds, allowed(principal, ACTION, some))


def _principal(connection: Connection, now_ns: int, credential: Credential) -> Principal | None:
    if credential.token:
        use = find_token(connection, now_ns, credential.token)
        return None if use is None else use.principal
    found = find_session(connection, now_ns, credential.session)
    return None if found is None else found.user.principal
