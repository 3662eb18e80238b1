"""User accounts: roles, and the groups of robots they are restricted to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, RowMapping, delete, func, insert, select, update

from amberbox.core.errors import UsageError, did_you_mean
from amberbox.server.accounts.permissions import Principal, Role
from amberbox.server.accounts.robots import groups_of, refuse_name, set_groups
from amberbox.server.schema import SESSIONS, USER_GROUPS, USERS


@dataclass(frozen=True, slots=True)
class User:
    """An account; ``groups`` None is all robots, an empty set is none."""

    user_id: int
    name: str
    role: Role
    groups: frozenset[str] | None
    must_change: bool
    created_ns: int
    changed_ns: int
    disabled_ns: int | None

    @property
    def principal(self) -> Principal:
        """The account as a principal, for permissions."""
        return Principal("user", self.name, self.role, self.groups, must_change=self.must_change)


def add_user(
    connection: Connection,
    now_ns: int,
    name: str,
    role: Role,
    password_hash: str,
    *,
    groups: Iterable[str] | None = None,
    must_change: bool = False,
) -> User:
    """Add an account; raises UsageError for a name that is taken, or an unknown group.

    The password is hashed before, outside the transaction: see ``passwords``.
    """
    refuse_name(name, "person")
    if _row(connection, name) is not None:
        raise UsageError(f"there is an account '{name}' already", "take another name")
    values = {
        "name": name,
        "role": str(role),
        "password_hash": password_hash,
        "all_robots": groups is None,
        "must_change": must_change,
        "created_ns": now_ns,
        "changed_ns": now_ns,
    }
    connection.execute(insert(USERS).values(values))
    user = find_user(connection, name)
    set_groups(connection, USER_GROUPS, user.user_id, groups or ())
    return find_user(connection, name)


def find_user(connection: Connection, name: str) -> User:
    """Return an account; raises UsageError when there is none of that name."""
    row = _row(connection, name)
    if row is None:
        known = list(connection.execute(select(USERS.c.name)).scalars())
        raise UsageError(f"there is no account '{name}'{did_you_mean(name, known)}")
    return user_of(connection, row)


def list_users(connection: Connection) -> list[User]:
    """Return all accounts, disabled ones too, by name."""
    found = connection.execute(select(USERS).order_by(USERS.c.name)).mappings().all()
    return [user_of(connection, row) for row in found]


def user_of(connection: Connection, row: RowMapping) -> User:
    """Return the account of a row."""
    groups = None if row["all_robots"] else groups_of(connection, USER_GROUPS, row["user_id"])
    return User(
        row["user_id"],
        row["name"],
        Role(row["role"]),
        groups,
        bool(row["must_change"]),
        row["created_ns"],
        row["changed_ns"],
        row["disabled_ns"],
    )


def set_role(connection: Connection, name: str, role: Role) -> None:
    """Change the role of an account; it counts from the next request, in open sessions too.

    Raises UsageError when no admin would be left.
    """
    user = find_user(connection, name)
    _change(connection, user, role=str(role))
    _keep_an_admin(connection)


def restrict(connection: Connection, name: str, groups: Iterable[str] | None) -> None:
    """Restrict an account to groups of robots; None lifts the restriction.

    Raises UsageError for an unknown group, or when no admin would be left.
    """
    user = find_user(connection, name)
    set_groups(connection, USER_GROUPS, user.user_id, groups or ())
    _change(connection, user, all_robots=groups is None)
    _keep_an_admin(connection)


def set_password(
    connection: Connection,
    now_ns: int,
    name: str,
    password_hash: str,
    *,
    must_change: bool = False,
) -> None:
    """Set the password of an account and end all its sessions.

    With ``must_change`` (another person knows the password) it has to be changed first.
    """
    user = find_user(connection, name)
    new = {"password_hash": password_hash, "must_change": must_change, "changed_ns": now_ns}
    _change(connection, user, **new)
    _end_sessions(connection, user)


def disable_user(connection: Connection, now_ns: int, name: str) -> None:
    """Close an account, end its sessions and stop its tokens; its name stays taken.

    Raises UsageError when no admin would be left.
    """
    user = find_user(connection, name)
    _change(connection, user, disabled_ns=now_ns)
    _end_sessions(connection, user)
    _keep_an_admin(connection)


def enable_user(connection: Connection, name: str) -> None:
    """Reopen a closed account."""
    _change(connection, find_user(connection, name), disabled_ns=None)


def has_admin(connection: Connection) -> bool:
    """Return whether there is an open admin account for all robots."""
    admins = (
        select(func.count())
        .select_from(USERS)
        .where(USERS.c.role == str(Role.ADMIN))
        .where(USERS.c.all_robots.is_(True))
        .where(USERS.c.disabled_ns.is_(None))
    )
    return bool(connection.execute(admins).scalar())


def _keep_an_admin(connection: Connection) -> None:
    """Raise UsageError, which rolls the change back, when no admin would be left."""
    if not has_admin(connection):
        raise UsageError(
            "this would leave nobody to administer the server",
            "make somebody else an admin for all robots first",
        )


def _change(connection: Connection, user: User, **new: object) -> None:
    connection.execute(update(USERS).where(USERS.c.user_id == user.user_id).values(new))


def _end_sessions(connection: Connection, user: User) -> None:
    connection.execute(delete(SESSIONS).where(SESSIONS.c.user_id == user.user_id))


def _row(connection: Connection, name: str) -> RowMapping | None:
    return connection.execute(select(USERS).where(USERS.c.name == name)).mappings().one_or_none()
