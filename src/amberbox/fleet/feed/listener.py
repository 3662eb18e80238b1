"""One listener: what it has heard, and what it hears next."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.fleet.feed.asked import Asked
from amberbox.fleet.feed.delta import PLAIN, Delta
from amberbox.fleet.feed.gate import Credential, Permission


@dataclass(frozen=True, slots=True)
class Filter:
    """What of all changes somebody hears; equal ones hear the same, but for their own jobs.

    ``reach`` are the robots of each kind, ``robots`` the same to look into.
    """

    reach: frozenset[tuple[str, frozenset[str]]]
    owners: frozenset[str] = field(compare=False)
    robots: Mapping[str, frozenset[str]] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "robots", dict(self.reach))

    def hears(self, delta: Delta) -> bool:
        """Tell whether a change is heard: of a job only by its owner."""
        robots = self.robots.get(delta.kind)
        if robots is None:
            return False
        return delta.owner in self.owners if delta.kind == "job" else delta.robot in robots


@dataclass(slots=True, eq=False)
class Listener:
    """Who listens, to what, and up to which number everything was sent.

    ``ended`` is the code with which the socket is to be closed, and why.
    """

    credential: Credential
    permission: Permission
    asked: Asked = field(default_factory=Asked)
    number: int = 0
    needs_snapshot: bool = True
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    live: dict[str, str] = field(default_factory=dict)
    ended: tuple[int, str] | None = None
    filter: Filter = field(init=False)

    def __post_init__(self) -> None:
        self.settle()

    @property
    def who(self) -> str:
        """Name the principal."""
        return str(self.permission.principal)

    @property
    def watch(self) -> Mapping[str, Sequence[str]]:
        """Return the live values that are looked at, of robots that may be seen."""
        robots = self.permission.robots
        return {robot: names for robot, names in self.asked.live.items() if robot in robots}

    @property
    def robots(self) -> frozenset[str]:
        """Return the robots that are listened to."""
        asked = self.asked.robots
        return self.permission.robots if asked is None else self.permission.robots & {*asked}

    def robots_of(self, kind: str) -> frozenset[str]:
        """Return the robots of which somebody hears changes of a kind."""
        return self.filter.robots.get(kind, frozenset())

    def settle(self) -> None:
        """Work out what is heard; after each change of what is asked or allowed."""
        kinds = PLAIN if self.asked.kinds is None else frozenset(self.asked.kinds)
        asked, may = self.robots, self.permission.kinds
        reach = frozenset((kind, asked & may[kind]) for kind in kinds)
        principal = self.permission.principal
        owner = principal.owner or principal.id  # tokens act for their owner
        self.filter = Filter(reach, frozenset((owner,) if may["job"] else ()))

    def end(self, code: int, reason: str) -> None:
        """Have the socket closed."""
        self.ended = code, reason
        self.wake.set()
