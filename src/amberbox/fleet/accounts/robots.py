"""The robots that the server knows, and the groups they are in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, RowMapping, insert, select, update

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.fleet.accounts.groups import groups_of, refuse_name, set_groups
from amberbox.fleet.accounts.principal import Robot
from amberbox.fleet.accounts.tables import ROBOT_GROUPS, ROBOTS


@dataclass(frozen=True, slots=True)
class KnownRobot:
    """A robot that was added; a disabled one cannot connect, what it sent is kept."""

    id: str
    groups: frozenset[str]
    added_ns: int
    disabled_ns: int | None

    @property
    def robot(self) -> Robot:
        """Return it as permissions see it."""
        return Robot(self.id, self.groups)


def register_robot(
    connection: Connection, now_ns: int, robot: str, groups: Iterable[str] = ()
) -> KnownRobot:
    """Make a robot known, without a key; raises UsageError when it is, or for unknown groups."""
    refuse_name(robot, "robot")
    if _row(connection, robot) is not None:
        raise UsageError(
            f"the robot '{robot}' is known already", "give it a new key if it lost its own"
        )
    connection.execute(insert(ROBOTS), [{"robot": robot, "added_ns": now_ns}])
    set_groups(connection, ROBOT_GROUPS, robot, groups)
    return find_robot(connection, robot)


def find_robot(connection: Connection, robot: str) -> KnownRobot:
    """Return a robot; raises UsageError for one that nobody added."""
    row = _row(connection, robot)
    if row is None:
        known = list(connection.execute(select(ROBOTS.c.robot)).scalars())
        hint = f"robots are: {', '.join(sorted(known)[:20])}" if known else "add it first"
        raise UsageError(f"there is no robot '{robot}'{did_you_mean(robot, known)}", hint)
    return _known(connection, row)


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
    """Put a robot into these groups and no others."""
    set_groups(connection, ROBOT_GROUPS, find_robot(connection, robot).id, groups)


def disable_robot(connection: Connection, now_ns: int, robot: str) -> None:
    """Refuse a robot from now on, whatever key it has."""
    _change(connection, robot, now_ns)


def enable_robot(connection: Connection, robot: str) -> None:
    """Let a robot connect again, with the keys that it has."""
    _change(connection, robot, None)


def _change(connection: Connection, robot: str, disabled_ns: int | None) -> None:
    known = find_robot(connection, robot)
    chosen = update(ROBOTS).where(ROBOTS.c.robot == known.id)
    connection.execute(chosen.values(disabled_ns=disabled_ns))


def _row(connection: Connection, robot: str) -> RowMapping | None:
    chosen = select(ROBOTS).where(ROBOTS.c.robot == robot)
    return connection.execute(chosen).mappings().one_or_none()


def _known(connection: Connection, row: RowMapping) -> KnownRobot:
    groups = groups_of(connection, ROBOT_GROUPS, row["robot"])
    return KnownRobot(row["robot"], groups, row["added_ns"], row["disabled_ns"])
