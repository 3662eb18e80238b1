"""Routes of robots: cards, component tree, timeline, events, link, enrolment and live feed."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException, Query, WebSocket
from pydantic import Field
from sqlalchemy import Connection
from starlette.websockets import WebSocketDisconnect

from amberbox.core.api import Card, Event, StatusTree, Timeline
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.link.join_line import join_line
from amberbox.server.accounts import robots as registry
from amberbox.server.accounts.passwords import Secret
from amberbox.server.bus import ServerChange
from amberbox.server.certificates import fingerprint
from amberbox.server.http.auth import COOKIE, Fleet, OfRobot, Routes, Who
from amberbox.server.http.forms import ID, AfterName, Form, Id, Limit, Named, TimeText
from amberbox.server.ingest import link_state
from amberbox.server.live import links
from amberbox.server.live.feed import FeedSession
from amberbox.server.live.listener import ACTION, Credential, LiveListener, permission
from amberbox.server.services import people, robots
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.people import WaitingKey

routes = Routes("robots")


Group = Annotated[str, Query(pattern=f"^$|{ID}", description="only robots of this group")]
Name = Annotated[str, Query(max_length=128)]
Points = Annotated[int, Query(ge=10, le=5000, description="at most so many stretches a lane")]
AfterNumber = Annotated[int, Query(ge=0, le=2**62, description="behind this number; 0: the newest")]


@routes.get("/robots", "status.read", each=True)
def list_cards(
    fleet: Fleet, who: Who, group: Group = "", after: AfterName = "", limit: Limit = 1000
) -> Sequence[Card]:
    """Return the robots that one may see, by id; also those that never connected."""
    return robots.list_cards(fleet, who, group, after, limit)


@routes.get("/robots/{robot}", "status.read")
def read_card(fleet: Fleet, robot: OfRobot) -> Card:
    """Return a robot at a glance."""
    return robots.read_card(fleet, robot)


@routes.get("/robots/{robot}/status", "status.read")
def read_status(fleet: Fleet, robot: OfRobot) -> StatusTree:
    """Return the components of a robot as a tree, with modes, outputs and what they need."""
    return robots.read_status(fleet, robot)


@routes.get("/robots/{robot}/timeline", "status.read")
def read_timeline(
    fleet: Fleet,
    robot: OfRobot,
    from_: Annotated[TimeText, Query(alias="from")] = "now-1h",
    to: TimeText = "now",
    component: Name = "",
    points: Points = 500,
) -> Timeline:
    """Return which component was in what state when."""
    return robots.read_timeline(fleet, robot, from_, to, component, points)


@routes.get("/robots/{robot}/events", "items.read")
def list_events(
    fleet: Fleet,
    robot: OfRobot,
    from_: Annotated[TimeText, Query(alias="from")] = "",
    to: TimeText = "",
    kind: Name = "",
    newest: bool = True,
    aside: bool = False,
    limit: Limit = 100,
) -> Sequence[Event]:
    """Return events of a robot in order of time: the newest of a range, or the first ones."""
    return robots.list_events(
        fleet, robot, from_, to, kind, newest=newest, aside=aside, limit=limit
    )


@routes.get("/robots/{robot}/link", "status.read")
def read_link(
    fleet: Fleet, robot: OfRobot, after: AfterNumber = 0, limit: Limit = 100
) -> links.Link:
    """Return what is known of a robot's link, and what was noticed of it."""
    return robots.read_link(fleet, robot, after, limit)


feed_routes = Routes("feed")

_BEARER = "bearer "


@feed_routes.socket("/feed", ACTION, each=True)
async def listen(websocket: WebSocket, fleet: Fleet, who: Who) -> None:
    """Say what you want to hear, then hear it: a snapshot, and what changes from there on."""
    credential = _credential(websocket)
    may = await asyncio.to_thread(permission, fleet.database, fleet.clock, credential)
    if may is None or may.principal.id != who.principal.id:
        raise HTTPException(401, "sign in first")
    listener = LiveListener(credential, may)
    if not fleet.feed.join(listener):
        raise HTTPException(429, "too many sockets are open")
    try:
        await websocket.accept()
        await FeedSession(fleet.feed, listener, _Socket(websocket)).run()
    finally:
        fleet.feed.leave(listener)


def _credential(websocket: WebSocket) -> Credential:
    header = websocket.headers.get("authorization", "")
    if header:
        return Credential(token=header[len(_BEARER) :].strip())
    return Credential(session=websocket.cookies.get(COOKIE, ""))


class _Socket:
    """An accepted WebSocket as the feed takes it."""

    def __init__(self, websocket: WebSocket) -> None:
        self._websocket = websocket

    async def receive(self) -> str | None:
        """Wait for a message; None at the end. Binary ones are none of ours."""
        try:
            got = await self._websocket.receive()
        except RuntimeError:  # it was closed before
            return None
        return (got.get("text") or "") if got["type"] == "websocket.receive" else None

    async def send(self, text: str) -> None:
        """Send a message; raises OSError when nobody is there any more."""
        try:
            await self._websocket.send({"type": "websocket.send", "text": text})
        except (RuntimeError, WebSocketDisconnect) as error:
            raise OSError("the socket is closed") from error

    async def close(self, code: int, reason: str) -> None:
        """End the connection; harmless when it has ended."""
        try:
            await self._websocket.close(code, reason[:100])
        except (RuntimeError, WebSocketDisconnect, OSError):
            return


enrolment_routes = Routes("robots")

_HOUR_NS = 3600 * NS
_LONGEST_H = 90 * 24


@dataclass(frozen=True, slots=True)
class EnrolledRobot:
    """The line to paste on the robot; its key is in it, and it is shown only here."""

    robot: str
    key_id: str
    line: str


@dataclass(frozen=True, slots=True)
class RobotKey:
    """A key as it is listed: what it opens is never shown again."""

    id: str
    created: str
    expires: str | None
    revoked: str | None
    used: str | None
    works: bool


@dataclass(frozen=True, slots=True)
class RegisteredRobot:
    """A robot that was added."""

    robot: str
    groups: list[str]
    added: str
    disabled: str | None


@dataclass(frozen=True, slots=True)
class RevokedKeys:
    """How many keys worked until now."""

    revoked: int


@dataclass(frozen=True, slots=True)
class DecidedKey:
    """How many journals were waiting for the decision."""

    journals: int


class KeyDecision(Form):
    """The key that waits, and whether it is the robot's own."""

    public_key: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    confirm: bool


class NewRobot(Form):
    """Which robot is added, and the groups it is in."""

    robot: Id
    groups: Annotated[list[Id], Field(max_length=200)] = Field(default_factory=list)


class ChangedRobot(Form):
    """What is to change; what is left out stays."""

    groups: Annotated[list[Id], Field(max_length=200)] | None = None
    disabled: bool | None = None


class NewKey(Form):
    """How many hours the keys before work on, so that a robot that is away can still come back."""

    overlap_h: Annotated[int, Field(ge=0, le=_LONGEST_H)] = registry.OVERLAP_NS // _HOUR_NS


@enrolment_routes.post("/robots", "robots.write", status_code=201)
def enrol(fleet: Fleet, who: Who, new: NewRobot) -> EnrolledRobot:
    """Add a robot; the line to paste on it is in the answer and nowhere else."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        secret = registry.add_robot(connection, now_ns, new.robot, new.groups)
        enrolled = _enrolled(fleet, new.robot, secret)
        details = {"groups": new.groups, "key_id": secret.id}
        who.note(connection, now_ns, "robots.add", new.robot, details=details)
    fleet.bus.publish(ServerChange("robot", new.robot))
    return enrolled


@enrolment_routes.patch("/robots/{robot}", "robots.write")
def change(fleet: Fleet, who: Who, robot: OfRobot, new: ChangedRobot) -> RegisteredRobot:
    """Put a robot into other groups, close it, or open it again."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        _apply(connection, now_ns, robot.id, new)
        details = new.model_dump(exclude_unset=True)
        who.note(connection, now_ns, "robots.change", robot.id, details=details)
        changed = registry.find_robot(connection, robot.id)
    fleet.bus.publish(ServerChange("robot", robot.id))
    added, disabled = format_time(changed.added_ns), maybe_time(changed.disabled_ns)
    return RegisteredRobot(changed.id, sorted(changed.groups), added, disabled)


def _apply(connection: Connection, now_ns: int, robot: str, new: ChangedRobot) -> None:
    if new.groups is not None:
        registry.regroup_robot(connection, robot, new.groups)
    if new.disabled is True:
        registry.disable_robot(connection, now_ns, robot)
    if new.disabled is False:
        registry.enable_robot(connection, robot)


@enrolment_routes.get("/robots/{robot}/keys", "robots.write")
def list_keys(fleet: Fleet, robot: OfRobot) -> list[RobotKey]:
    """List the keys that a robot has had, newest first."""
    now_ns = fleet.clock.wall_ns()
    with fleet.database.reading() as connection:
        return [_key(key, now_ns) for key in registry.list_keys(connection, robot.id)]


@enrolment_routes.post("/robots/{robot}/key", "robots.write", status_code=201)
def replace_key(fleet: Fleet, who: Who, robot: OfRobot, new: NewKey | None = None) -> EnrolledRobot:
    """Give a robot a new key; the line to paste is in the answer and nowhere else."""
    overlap_h = (new or NewKey()).overlap_h
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        secret = registry.rotate_key(connection, now_ns, robot.id, overlap_h * _HOUR_NS)
        enrolled = _enrolled(fleet, robot.id, secret)
        details = {"key_id": secret.id, "overlap_h": overlap_h}
        who.note(connection, now_ns, "robots.key", robot.id, details=details)
    fleet.bus.publish(ServerChange("robot", robot.id))
    return enrolled


@enrolment_routes.get("/signing-keys", "robots.write")
def list_waiting_keys(fleet: Fleet) -> list[WaitingKey]:
    """List the keys that robots sign with since, and that no admin has confirmed or refused."""
    return people.list_waiting_keys(fleet)


@enrolment_routes.post("/robots/{robot}/signing-key", "robots.write")
def decide_key(fleet: Fleet, who: Who, robot: OfRobot, decision: KeyDecision) -> DecidedKey:
    """Confirm the new key of a robot, as after a reinstallation, or refuse it.

    Journals that it signed were kept aside; they are verified with the confirmation.
    """
    with fleet.database.begin() as connection:
        now_ns, key = fleet.clock.wall_ns(), decision.public_key
        journals = link_state.decide(connection, now_ns, robot.id, key, confirm=decision.confirm)
        details = {"public_key": key, "journals": journals}
        action = f"robots.signing_key.{'confirm' if decision.confirm else 'refuse'}"
        who.note(connection, now_ns, action, robot.id, details=details)
    fleet.bus.publish(ServerChange("robot", robot.id))
    return DecidedKey(journals)


@enrolment_routes.delete("/robots/{robot}/keys/{key}", "robots.write")
def revoke_key(fleet: Fleet, who: Who, robot: OfRobot, key: Named) -> RevokedKeys:
    """Revoke one key of a robot, at once."""
    revoked = _revoke(fleet, who, robot.id, key)
    if not revoked.revoked:
        raise HTTPException(404, "this robot has no such key that works")
    return revoked


@enrolment_routes.delete("/robots/{robot}/keys", "robots.write")
def revoke_keys(fleet: Fleet, who: Who, robot: OfRobot) -> RevokedKeys:
    """Revoke all keys of a robot, at once: it was stolen, or its card was."""
    return _revoke(fleet, who, robot.id, "")


def _revoke(fleet: Services, who: Caller, robot: str, key: str) -> RevokedKeys:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        revoked = registry.revoke_keys(connection, now_ns, robot, key)
        if revoked:
            details = {"key_id": key or "all", "revoked": revoked}
            who.note(connection, now_ns, "robots.key.revoke", robot, details=details)
    fleet.bus.publish(ServerChange("robot", robot))
    return RevokedKeys(revoked)


def _enrolled(fleet: Services, robot: str, secret: Secret) -> EnrolledRobot:
    ca = "" if fleet.settings.certificate is None else fingerprint(fleet.folder)
    line = join_line(fleet.settings.public_url, robot, secret.text, ca)
    return EnrolledRobot(robot, secret.id, str(line))


def _key(key: registry.StoredRobotKey, now_ns: int) -> RobotKey:
    return RobotKey(
        key.key_id,
        format_time(key.created_ns),
        maybe_time(key.expires_ns),
        maybe_time(key.revoked_ns),
        maybe_time(key.used_ns),
        key.works(now_ns),
    )
