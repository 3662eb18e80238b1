"""A listener of the live feed: subscription, permission, position; changes as messages."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

import msgspec
from msgspec import Meta
from sqlalchemy import Connection

from amberbox.core.clock import Clock
from amberbox.core.errors import UsageError
from amberbox.link import limits
from amberbox.server.accounts.permissions import Principal, RobotGroups, allowed
from amberbox.server.accounts.robots import list_robots
from amberbox.server.accounts.sessions import find_session
from amberbox.server.accounts.tokens import find_token
from amberbox.server.database import ServerDatabase

Kind: TypeAlias = Literal[
    "presence", "status", "levels", "ages", "event", "diagnosis", "alarm", "job", "fetch",
    "command", "run",
]  # fmt: skip
KINDS: Final[frozenset[str]] = frozenset(get_args(Kind))
# The kinds of changes of a subscription that names none
PLAIN: Final[frozenset[str]] = KINDS - {"ages", "levels"}
HELD = 10_000
HELD_BYTES = 64 << 20

_encode = msgspec.json.Encoder().encode


@dataclass(frozen=True, slots=True)
class Delta:
    """One change: ``text`` is its JSON, ``at_s`` its time, ``owner`` the owner of its job."""

    number: int
    kind: Kind
    robot: str
    text: str
    at_s: float
    owner: str = ""


def message(number: int, kind: str, robot: str, data: Any) -> str:
    """Return a message as JSON: number, kind, robot, data."""
    return _encode({"number": number, "kind": kind, "robot": robot, "data": data}).decode()


class ChangeRing:
    """A ring buffer of the newest changes; ``number`` is that of the last one, without gaps.

    Numbers begin with the start time in microseconds, so that a number from before a restart is
    never taken for a current one.
    """

    def __init__(self, start_ns: int, held: int = HELD, held_bytes: int = HELD_BYTES) -> None:
        self.number = start_ns // 1000
        self._deltas: deque[Delta] = deque()
        self._held = held
        self._held_bytes = held_bytes
        self._bytes = 0

    def add(self, kind: Kind, robot: str, data: Any, at_s: float, owner: str = "") -> Delta:
        """Number a change and store it."""
        self.number += 1
        text = message(self.number, kind, robot, data)
        delta = Delta(self.number, kind, robot, text, at_s, owner)
        self._deltas.append(delta)
        self._bytes += len(text)
        while len(self._deltas) > self._held or self._bytes > self._held_bytes:
            self._bytes -= len(self._deltas.popleft().text)
        return delta

    def holds(self, number: int) -> bool:
        """Return whether all changes after a number are stored."""
        return self.number - len(self._deltas) <= number <= self.number

    def after(self, number: int) -> Iterator[Delta]:
        """Return an iterator of the stored changes after a number, oldest first."""
        count = min(max(self.number - number, 0), len(self._deltas))
        return (self._deltas[index] for index in range(-count, 0))


MESSAGE_BYTES = 256 << 10
_Robot = Annotated[str, Meta(max_length=64)]
_Variable = Annotated[str, Meta(max_length=512, min_length=1)]
_Variables = Annotated[list[_Variable], Meta(max_length=limits.VARIABLES)]


class FeedSubscription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which robots and kinds (null: all), which live values, and from which number on."""

    robots: Annotated[list[_Robot], Meta(max_length=2000)] | None = None
    kinds: Annotated[list[str], Meta(max_length=20)] | None = None
    live: Annotated[dict[_Robot, _Variables], Meta(max_length=100)] = {}
    resume: int | None = None


_DECODER = msgspec.json.Decoder(FeedSubscription)


def parse_subscription(text: str | bytes) -> FeedSubscription:
    """Decode a subscription; raises UsageError."""
    if len(text) > MESSAGE_BYTES:
        raise UsageError(f"a message has at most {MESSAGE_BYTES} bytes", "ask for fewer robots")
    try:
        asked = _DECODER.decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        hint = 'send {"robots": null, "kinds": null, "live": {"ropod_001": ["odom.x"]}}'
        raise UsageError(f"this cannot be subscribed to: {error}", hint) from error
    unknown = sorted(set(asked.kinds or ()) - KINDS)
    if unknown:
        raise UsageError(f"there is no kind {unknown[0]!r}", f"kinds: {', '.join(sorted(KINDS))}")
    return asked


ACTION = "status.read"
# The permission that each kind of change needs
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
    "command": "commands.read",
    "run": "experiments.read",
}


@dataclass(frozen=True, slots=True)
class Credential:
    """The credential of a listener: a session's cookie, or a token."""

    session: str = field(default="", repr=False)
    token: str = field(default="", repr=False)


@dataclass(frozen=True, slots=True)
class Permission:
    """What a listener may receive: robots, and kinds of change for each."""

    principal: Principal
    kinds: dict[str, frozenset[str]]
    may_listen: bool = True

    @property
    def robots(self) -> frozenset[str]:
        """The robots that the listener may see."""
        return self.kinds.get("status", frozenset())


def permission(database: ServerDatabase, clock: Clock, credential: Credential) -> Permission | None:
    """Return the permission of a credential now; None when it is no longer valid."""
    with database.reading() as connection:
        principal = _principal(connection, clock.wall_ns(), credential)
        if principal is None:
            return None
        robots = list_robots(connection)
    kinds = {
        kind: frozenset(robot.id for robot in robots if allowed(principal, action, robot.robot))
        for kind, action in _NEEDS.items()
    }
    some = RobotGroups("", principal.groups or frozenset())
    return Permission(principal, kinds, allowed(principal, ACTION, some))


def _principal(connection: Connection, now_ns: int, credential: Credential) -> Principal | None:
    if credential.token:
        use = find_token(connection, now_ns, credential.token)
        return None if use is None else use.principal
    found = find_session(connection, now_ns, credential.session)
    return None if found is None else found.user.principal


@dataclass(frozen=True, slots=True)
class FeedFilter:
    """Which changes a listener receives; equal filters pass the same, except for jobs of others.

    ``reach`` are the robots of each kind as hashable pairs, ``robots`` the same as a mapping.
    """

    reach: frozenset[tuple[str, frozenset[str]]]
    owners: frozenset[str] = field(compare=False)
    robots: Mapping[str, frozenset[str]] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "robots", dict(self.reach))

    def matches(self, delta: Delta) -> bool:
        """Return whether a change passes: a job only for its owner."""
        robots = self.robots.get(delta.kind)
        if robots is None:
            return False
        return delta.owner in self.owners if delta.kind == "job" else delta.robot in robots


@dataclass(slots=True, eq=False)
class LiveListener:
    """A listener: its subscription, and the number up to which everything was sent.

    ``ended`` is the code and the reason with which the socket is to be closed.
    """

    credential: Credential
    permission: Permission
    asked: FeedSubscription = field(default_factory=FeedSubscription)
    number: int = 0
    needs_snapshot: bool = True
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    live: dict[str, str] = field(default_factory=dict)
    ended: tuple[int, str] | None = None
    filter: FeedFilter = field(init=False)

    def __post_init__(self) -> None:
        self.settle()

    @property
    def who(self) -> str:
        """Name of the principal."""
        return str(self.permission.principal)

    @property
    def watch(self) -> Mapping[str, Sequence[str]]:
        """Return the watched live values, of robots that the listener may see."""
        robots = self.permission.robots
        return {robot: names for robot, names in self.asked.live.items() if robot in robots}

    @property
    def robots(self) -> frozenset[str]:
        """Return the robots of the subscription that the listener may see."""
        asked = self.asked.robots
        return self.permission.robots if asked is None else self.permission.robots & {*asked}

    def robots_of(self, kind: str) -> frozenset[str]:
        """Return the robots whose changes of a kind the listener receives."""
        return self.filter.robots.get(kind, frozenset())

    def settle(self) -> None:
        """Update the filter, after each change of subscription or permission."""
        kinds = PLAIN if self.asked.kinds is None else frozenset(self.asked.kinds)
        asked, may = self.robots, self.permission.kinds
        reach = frozenset((kind, asked & may[kind]) for kind in kinds)
        principal = self.permission.principal
        owner = principal.owner or principal.id  # tokens act for their owner
        self.filter = FeedFilter(reach, frozenset((owner,) if may["job"] else ()))

    def end(self, code: int, reason: str) -> None:
        """Request that the socket is closed."""
        self.ended = code, reason
        self.wake.set()
