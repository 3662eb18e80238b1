"""Registered robots, the groups they are in, and their keys: rotated with an overlap."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    RowMapping,
    Table,
    Update,
    delete,
    insert,
    or_,
    select,
    update,
)

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.core.names import is_id
from amberbox.link.join_line import is_secret
from amberbox.server.accounts.passwords import Secret, digest, new_secret
from amberbox.server.accounts.permissions import Principal, RobotGroups
from amberbox.server.schema import GROUPS, ROBOT_GROUPS, ROBOT_KEYS, ROBOTS


def add_group(connection: Connection, now_ns: int, name: str) -> None:
    """Add a group; raises UsageError for an existing or an invalid name."""
    refuse_name(name, "group")
    if name in list_groups(connection):
        raise UsageError(f"there is a group '{name}' already", "take another name")
    connection.execute(insert(GROUPS), [{"name": name, "created_ns": now_ns}])


def remove_group(connection: Connection, name: str) -> None:
    """Remove a group from all members; an account restricted to it alone then sees no robot.

    Raises UsageError when there is none of that name.
    """
    if not connection.execute(delete(GROUPS).where(GROUPS.c.name == name)).rowcount:
        raise _unknown(name, list_groups(connection))


def list_groups(connection: Connection) -> list[str]:
    """Return the names of all groups, sorted."""
    return list(connection.execute(select(GROUPS.c.name).order_by(GROUPS.c.name)).scalars())


def groups_of(connection: Connection, table: Table, member: int | str) -> frozenset[str]:
    """Return the groups of a member; ``table`` has one row per member and group."""
    of, group = table.primary_key.columns
    return frozenset(connection.execute(select(group).where(of == member)).scalars())


def set_groups(
    connection: Connection, table: Table, member: int | str, groups: Iterable[str]
) -> None:
    """Replace the groups of a member; raises UsageError for an unknown group."""
    known, wanted = list_groups(connection), sorted(set(groups))
    for name in wanted:
        if name not in known:
            raise _unknown(name, known)
    of, group = table.primary_key.columns
    connection.execute(delete(table).where(of == member))
    if wanted:
        connection.execute(insert(table), [{of.name: member, group.name: name} for name in wanted])


def refuse_name(name: str, kind: str) -> None:
    """Raise UsageError for a new name that is no id, or that begins with a hyphen."""
    if not is_id(name) or name.startswith("-"):
        raise UsageError(
            f"not a name of a {kind}: {name!r}",
            "take 1 to 64 of a-z, 0-9, point, hyphen (not first) and underscore",
        )


def _unknown(name: str, known: Collection[str]) -> UsageError:
    listed = f"groups are: {', '.join(known)}" if known else "there are no groups yet"
    return UsageError(f"there is no group '{name}'{did_you_mean(name, known)}", listed)


@dataclass(frozen=True, slots=True)
class KnownRobot:
    """A registered robot; a disabled one cannot connect, its data are kept."""

    id: str
    groups: frozenset[str]
    added_ns: int
    disabled_ns: int | None

    @property
    def robot(self) -> RobotGroups:
        """Return its id and groups, as permissions need them."""
        return RobotGroups(self.id, self.groups)


def register_robot(
    connection: Connection, now_ns: int, robot: str, groups: Iterable[str] = ()
) -> KnownRobot:
    """Register a robot without a key; raises UsageError when it is registered already.

    Raises UsageError also for an invalid name and for unknown groups.
    """
    refuse_name(robot, "robot")
    if _row(connection, robot) is not None:
        raise UsageError(
            f"the robot '{robot}' is known already", "give it a new key if it lost its own"
        )
    connection.execute(insert(ROBOTS), [{"robot": robot, "added_ns": now_ns}])
    set_groups(connection, ROBOT_GROUPS, robot, groups)
    return find_robot(connection, robot)


def find_robot(connection: Connection, robot: str) -> KnownRobot:
    """Return a robot; raises UsageError for one that is not registered."""
    row = _row(connection, robot)
    if row is None:
        known = list(connection.execute(select(ROBOTS.c.robot)).scalars())
        hint = f"robots are: {', '.join(sorted(known)[:20])}" if known else "add it first"
        raise UsageError(f"there is no robot '{robot}'{did_you_mean(robot, known)}", hint)
    groups = groups_of(connection, ROBOT_GROUPS, robot)
    return KnownRobot(robot, groups, row["added_ns"], row["disabled_ns"])


def list_robots(connection: Connection) -> list[KnownRobot]:
    """Return all robots, disabled ones too, by id."""
    found = connection.execute(select(ROBOTS).order_by(ROBOTS.c.robot)).mappings().all()
    groups: dict[str, set[str]] = {}
    for robot, group in connection.execute(select(ROBOT_GROUPS.c.robot, ROBOT_GROUPS.c.group)):
        groups.setdefault(robot, set()).add(group)
    return [
        KnownRobot(
            row["robot"],
            frozenset(groups.get(row["robot"], ())),
            row["added_ns"],
            row["disabled_ns"],
        )
        for row in found
    ]


def regroup_robot(connection: Connection, robot: str, groups: Iterable[str]) -> None:
    """Replace the groups of a robot; raises UsageError for an unknown robot or group."""
    set_groups(connection, ROBOT_GROUPS, find_robot(connection, robot).id, groups)


def disable_robot(connection: Connection, now_ns: int, robot: str) -> None:
    """Refuse connections of a robot from now on, with any key."""
    _change(connection, robot, now_ns)


def enable_robot(connection: Connection, robot: str) -> None:
    """Allow a disabled robot to connect again, with its present keys."""
    _change(connection, robot, None)


def _change(connection: Connection, robot: str, disabled_ns: int | None) -> None:
    chosen = update(ROBOTS).where(ROBOTS.c.robot == find_robot(connection, robot).id)
    connection.execute(chosen.values(disabled_ns=disabled_ns))


def _row(connection: Connection, robot: str) -> RowMapping | None:
    chosen = select(ROBOTS).where(ROBOTS.c.robot == robot)
    return connection.execute(chosen).mappings().one_or_none()


OVERLAP_NS = 7 * 24 * 3600 * NS
_TOUCH_NS = 60 * NS
_SCHEME = "robot "


@dataclass(frozen=True, slots=True)
class StoredRobotKey:
    """The record of a robot's key, without the secret itself."""

    key_id: str
    robot: str
    created_ns: int
    expires_ns: int | None
    revoked_ns: int | None
    used_ns: int | None

    def works(self, now_ns: int) -> bool:
        """Return whether the key is neither revoked nor expired."""
        return self.revoked_ns is None and (self.expires_ns is None or now_ns < self.expires_ns)


@dataclass(frozen=True, slots=True)
class RobotUse:
    """An authenticated robot, and the key it used."""

    principal: Principal
    key: StoredRobotKey


def add_robot(
    connection: Connection, now_ns: int, robot: str, groups: Iterable[str] = ()
) -> Secret:
    """Register a robot and add a key; the key's text is only in the returned secret."""
    return _add_key(connection, now_ns, register_robot(connection, now_ns, robot, groups).id)


def rotate_key(
    connection: Connection, now_ns: int, robot: str, overlap_ns: int = OVERLAP_NS
) -> Secret:
    """Add a new key for a robot; its present keys expire after ``overlap_ns`` at the latest.

    For a key that may have been stolen, call ``revoke_keys`` first.
    """
    id_ = find_robot(connection, robot).id
    ends_ns = now_ns + overlap_ns
    later = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > ends_ns)
    connection.execute(_keys_of(id_).where(later).values(expires_ns=ends_ns))
    return _add_key(connection, now_ns, id_)


def revoke_keys(connection: Connection, now_ns: int, robot: str, key_id: str = "") -> int:
    """Revoke all keys of a robot, or one; return how many worked until now.

    Open connections check ``key_works`` at every heartbeat.
    """
    chosen = _keys_of(find_robot(connection, robot).id)
    chosen = chosen.where(ROBOT_KEYS.c.key_id == key_id) if key_id else chosen
    not_over = or_(ROBOT_KEYS.c.expires_ns.is_(None), ROBOT_KEYS.c.expires_ns > now_ns)
    still = chosen.where(ROBOT_KEYS.c.revoked_ns.is_(None), not_over)
    return connection.execute(still.values(revoked_ns=now_ns)).rowcount


def list_keys(connection: Connection, robot: str) -> list[StoredRobotKey]:
    """Return the keys that a robot has had, newest first."""
    chosen = select(*_listed()).where(ROBOT_KEYS.c.robot == robot)
    ordered = chosen.order_by(ROBOT_KEYS.c.created_ns.desc(), ROBOT_KEYS.c.key_id)
    return [StoredRobotKey(*row) for row in connection.execute(ordered)]


def find_robot_key(connection: Connection, now_ns: int, robot: str, key: str) -> RobotUse | None:
    """Return robot and key; None when the key is unknown, of another robot, expired or revoked.

    None also for a robot that is disabled.
    """
    if not is_secret(key, "robot"):
        return None
    joined = select(*_listed()).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
    chosen = joined.where(ROBOT_KEYS.c.hash == digest(key), ROBOTS.c.disabled_ns.is_(None))
    row = connection.execute(chosen).one_or_none()
    held = None if row is None else StoredRobotKey(*row)
    if held is None or held.robot != robot or not held.works(now_ns):
        return None
    return RobotUse(Principal("robot", robot), held)


def key_works(connection: Connection, now_ns: int, key_id: str) -> bool:
    """Return whether a connection that was opened with a key may stay open."""
    joined = select(*_listed()).join(ROBOTS, ROBOTS.c.robot == ROBOT_KEYS.c.robot)
    chosen = joined.where(ROBOT_KEYS.c.key_id == key_id, ROBOTS.c.disabled_ns.is_(None))
    row = connection.execute(chosen).one_or_none()
    return row is not None and StoredRobotKey(*row).works(now_ns)


def touch_key(connection: Connection, now_ns: int, key: StoredRobotKey) -> None:
    """Store when a key was last used, at most once a minute."""
    if key.used_ns is None or now_ns - key.used_ns >= _TOUCH_NS:
        chosen = update(ROBOT_KEYS).where(ROBOT_KEYS.c.key_id == key.key_id)
        connection.execute(chosen.values(used_ns=now_ns))


def read_authorization(header: str) -> tuple[str, str] | None:
    """Return robot and key of the header ``Robot <id>:<key>``; None for any other header."""
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
    return [ROBOT_KEYS.c[field.name] for field in fields(StoredRobotKey)]
