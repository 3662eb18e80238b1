"""Robots as admins see them: added with one line to paste, regrouped, closed, given new keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException
from pydantic import Field
from sqlalchemy import Connection

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts import robotkeys, robots
from amberbox.fleet.accounts.authority import fingerprint
from amberbox.fleet.accounts.keys import Secret
from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.forms import Form, Id, Named, shown
from amberbox.fleet.bus import Change
from amberbox.fleet.linkend import signingkeys
from amberbox.fleet.services import Services
from amberbox.link.joining import join_line

routes = Routes("robots")

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
class WaitingKey:
    """A key that a robot signs with instead of the one before; it waits for an admin."""

    robot: str
    store_id: str
    public_key: str
    first_seen: str


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

    overlap_h: Annotated[int, Field(ge=0, le=_LONGEST_H)] = robotkeys.OVERLAP_NS // _HOUR_NS


@routes.post("/robots", "robots.write", status_code=201)
def enrol(fleet: Fleet, who: Who, new: NewRobot) -> EnrolledRobot:
    """Add a robot; the line to paste on it is in the answer and nowhere else."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        secret = robotkeys.add_robot(connection, now_ns, new.robot, new.groups)
        enrolled = _enrolled(fleet, new.robot, secret)
        told = {"groups": new.groups, "key_id": secret.id}
        who.note(connection, now_ns, "robots.add", new.robot, details=told)
    _tell(fleet, new.robot)
    return enrolled


@routes.patch("/robots/{robot}", "robots.write")
def change(fleet: Fleet, who: Who, robot: OfRobot, new: ChangedRobot) -> RegisteredRobot:
    """Put a robot into other groups, close it, or open it again."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        _apply(connection, now_ns, robot.id, new)
        details = new.model_dump(exclude_unset=True)
        who.note(connection, now_ns, "robots.change", robot.id, details=details)
        changed = robots.find_robot(connection, robot.id)
    _tell(fleet, robot.id)
    added, disabled = format_time(changed.added_ns), shown(changed.disabled_ns)
    return RegisteredRobot(changed.id, sorted(changed.groups), added, disabled)


def _apply(connection: Connection, now_ns: int, robot: str, new: ChangedRobot) -> None:
    if new.groups is not None:
        robots.regroup_robot(connection, robot, new.groups)
    if new.disabled is True:
        robots.disable_robot(connection, now_ns, robot)
    if new.disabled is False:
        robots.enable_robot(connection, robot)


@routes.get("/robots/{robot}/keys", "robots.write")
def list_keys(fleet: Fleet, robot: OfRobot) -> list[RobotKey]:
    """List the keys that a robot has had, newest first."""
    now_ns = fleet.clock.wall_ns()
    with fleet.database.reading() as connection:
        return [_key(key, now_ns) for key in robotkeys.list_keys(connection, robot.id)]


@routes.post("/robots/{robot}/key", "robots.write", status_code=201)
def replace_key(fleet: Fleet, who: Who, robot: OfRobot, new: NewKey | None = None) -> EnrolledRobot:
    """Give a robot a new key; the line to paste is in the answer and nowhere else."""
    overlap_h = (new or NewKey()).overlap_h
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        secret = robotkeys.rotate_key(connection, now_ns, robot.id, overlap_h * _HOUR_NS)
        enrolled = _enrolled(fleet, robot.id, secret)
        told = {"key_id": secret.id, "overlap_h": overlap_h}
        who.note(connection, now_ns, "robots.key", robot.id, details=told)
    _tell(fleet, robot.id)
    return enrolled


@routes.get("/signing-keys", "robots.write")
def list_waiting_keys(fleet: Fleet) -> list[WaitingKey]:
    """List the keys that robots sign with since, and that no admin has confirmed or refused."""
    with fleet.database.reading() as connection:
        return [
            WaitingKey(key.robot, key.store_id, key.public_key, format_time(key.first_seen_ns))
            for key in signingkeys.pending_keys(connection)
        ]


@routes.post("/robots/{robot}/signing-key", "robots.write")
def decide_key(fleet: Fleet, who: Who, robot: OfRobot, decision: KeyDecision) -> DecidedKey:
    """Confirm the new key of a robot, as after a reinstallation, or refuse it.

    Journals that it signed were kept aside; they are verified with the confirmation.
    """
    with fleet.database.begin() as connection:
        now_ns, key = fleet.clock.wall_ns(), decision.public_key
        journals = signingkeys.decide(connection, now_ns, robot.id, key, confirm=decision.confirm)
        told = {"public_key": key, "journals": journals}
        action = f"robots.signing_key.{'confirm' if decision.confirm else 'refuse'}"
        who.note(connection, now_ns, action, robot.id, details=told)
    _tell(fleet, robot.id)
    return DecidedKey(journals)


@routes.delete("/robots/{robot}/keys/{key}", "robots.write")
def revoke_key(fleet: Fleet, who: Who, robot: OfRobot, key: Named) -> RevokedKeys:
    """Revoke one key of a robot, at once."""
    revoked = _revoke(fleet, who, robot.id, key)
    if not revoked.revoked:
        raise HTTPException(404, "this robot has no such key that works")
    return revoked


@routes.delete("/robots/{robot}/keys", "robots.write")
def revoke_keys(fleet: Fleet, who: Who, robot: OfRobot) -> RevokedKeys:
    """Revoke all keys of a robot, at once: it was stolen, or its card was."""
    return _revoke(fleet, who, robot.id, "")


def _revoke(fleet: Services, who: Caller, robot: str, key: str) -> RevokedKeys:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        revoked = robotkeys.revoke_keys(connection, now_ns, robot, key)
        if revoked:
            told = {"key_id": key or "all", "revoked": revoked}
            who.note(connection, now_ns, "robots.key.revoke", robot, details=told)
    _tell(fleet, robot)
    return RevokedKeys(revoked)


def _enrolled(fleet: Services, robot: str, secret: Secret) -> EnrolledRobot:
    ca = "" if fleet.settings.certificate is None else fingerprint(fleet.folder)
    line = join_line(fleet.settings.public_url, robot, secret.text, ca)
    return EnrolledRobot(robot, secret.id, str(line))


def _key(key: robotkeys.RobotKey, now_ns: int) -> RobotKey:
    return RobotKey(
        key.key_id,
        format_time(key.created_ns),
        shown(key.expires_ns),
        shown(key.revoked_ns),
        shown(key.used_ns),
        key.works(now_ns),
    )


def _tell(fleet: Services, robot: str) -> None:
    fleet.bus.publish(Change("robot", robot))
