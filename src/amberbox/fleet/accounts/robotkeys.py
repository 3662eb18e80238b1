"""Keys of robots: one per robot, replaced with an overlap, revoked at once.

A robot says ``Authorization: Robot <id>:<key>`` and may write only as itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import ColumnElement, Connection, Update, insert, or_, select, update

from amberbox.core.clock import NS
from amberbox.fleet.accounts.keys import Secret, digest, new_secret
from amberbox.fleet.accounts.principal import Principal
from amberbox.fleet.accounts.robots import find_robot, register_robot
from amberbox.fleet.accounts.tables import ROBOT_KEYS, ROBOTS
from amberbox.link.keys import is_secret

OVERLAP_NS = 7 * 24 * 3600 * NS
_TOUCH_NS = 60 * NS
_SCHEME = "robot "


@dataclass(frozen=True, slots=True)
class RobotKey:
    """A key as it is listed: what it opens is never shown again."""

    key_id: str
    robot: str
    created_ns: int
    expires_ns: int | None
    revoked_ns: int | None
    used_ns: int | None

    def works(self, now_ns: int) -> bool:
        """Tell whether a robot may still use it."""
        return self.revoked_ns is None and (self.expires_ns is None or now_ns < self.expires_ns)


@dataclass(frozen=True, slots=True)
class RobotUse:
    """Which robot this is, and with which key it says so."""

    principal: Principal
    key: RobotKey


def add_robot(
    connection: Connection, now_ns: int, robot: str, groups: Iterable[str] = ()
) -> Secret:
    """Make a robot known and give it a key; its text is in the answer and nowhere else."""
    return _add_key(connection, now_ns, register_robot(connection, now_ns, robot, groups).id)


def rotate_key(
    connection: Connection, now_ns: int, robot: str, overlap_ns: int = OVERLAP_NS
) -> Secret:
    """Give a robot a new key; those it has work for ``overlap_ns`` longer, and no more after.

    A key that somebody may have stolen is revoked instead: ``revoke_keys``, then this.
    """
    id_ = find_robot(connection, robot).id
    ends_ns = now_ns + overlap_ns
    later = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > ends_ns)
    connection.execute(_keys_of(id_).where(later).values(expires_ns=ends_ns))
    return _add_key(connection, now_ns, id_)


def revoke_keys(connection: Connection, now_ns: int, robot: str, key_id: str = "") -> int:
    """Revoke all keys of a robot, or one; return how many worked until now.

    Connections that are open ask ``key_works`` at every heartbeat.
    """
    chosen = _keys_of(find_robot(connection, robot).id)
    chosen = chosen.where(ROBOT_KEYS.c.key_id == key_id) if key_id else chosen
    not_over = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > now_ns)
    still = chosen.where(ROBOT_KEYS.c.revoked_ns.is_(None), not_over)
    return connection.execute(still.values(revoked_ns=now_ns)).rowcount


def list_keys(connection: Connection, robot: str) -> list[RobotKey]:
    """Return the keys that a robot has had, newest first."""
    chosen = select(*_listed()).where(ROBOT_KEYS.c.robot == robot)
    ordered = chosen.order_by(ROBOT_KEYS.c.created_ns.desc(), ROBOT_KEYS.c.key_id)
    return [RobotKey(*row) for row in connection.execute(ordered)]


def find_robot_key(connection: Connection, now_ns: int, robot: str, key: str) -> RobotUse | None:
    """Return which robot this is; None when the key is not this robot's, does not work any more,
    or the robot is disabled.
    """
    if not is_secret(key, "robot"):
        return None
    joined = select(*_listed()).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
    chosen = joined.where(ROBOT_KEYS.c.hash == digest(key), ROBOTS.c.disabled_ns.is_(None))
    row = connection.execute(chosen).one_or_none()
    held = None if row is None else RobotKey(*row)
    if held is None or held.robot != robot or not held.works(now_ns):
        return None
    return RobotUse(Principal("robot", robot), held)


def key_works(connection: Connection, now_ns: int, key_id: str) -> bool:
    """Tell whether a connection that was opened with a key may stay open."""
    joined = select(*_listed()).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
    chosen = joined.where(ROBOT_KEYS.c.key_id == key_id, ROBOTS.c.disabled_ns.is_(None))
    row = connection.execute(chosen).one_or_none()
    return row is not None and RobotKey(*row).works(now_ns)


def touch_key(connection: Connection, now_ns: int, key: RobotKey) -> None:
    """Note that a key was used, to the minute."""
    if key.used_ns is None or now_ns - key.used_ns >= _TOUCH_NS:
        chosen = update(ROBOT_KEYS).where(ROBOT_KEYS.c.key_id == key.key_id)
        connection.execute(chosen.values(used_ns=now_ns))


def read_authorization(header: str) -> tuple[str, str] | None:
    """Read ``Robot <id>:<key>``; robot and key, or None if it is something else."""
    if header[: len(_SCHEME)].lower() != _SCHEME:
        return None
    robot, colon, key = header[len(_SCHEME) :].strip().partition(":")
    return (robot, key) if robot and colon and key else None


def _add_key(connection: Connection, now_ns: int, robot: str) -> Secret:
    secret = new_secret("robot")
    row = {"key_id": secret.id, "robot": robot, "hash": secret.hash, "created_ns": now_ns}
    connection.execute(insert(ROBOT_KEYS), [row])
    return secret


def _keys_of(robot: str) -> Update:
    return update(ROBOT_KEYS).where(ROBOT_KEYS.c.robot == robot)


def _listed() -> list[ColumnElement[Any]]:
    return [ROBOT_KEYS.c[field.name] for field in fields(RobotKey)]
