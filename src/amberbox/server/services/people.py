"""Accounts, groups, sessions, tokens and keys that wait, as API and pages show them."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.server.accounts import robots, sessions, tokens, users
from amberbox.server.accounts.permissions import Role
from amberbox.server.ingest import link_state
from amberbox.server.services.context import Caller, NotFoundError, Services


def list_people(fleet: Services, after: str = "", limit: int = 100) -> list[Person]:
    """List the accounts by name, closed ones too."""
    with fleet.database.reading() as connection:
        found = [user for user in users.list_users(connection) if user.name > after]
    return [describe_person(user) for user in found[:limit]]


def list_groups(fleet: Services, after: str = "", limit: int = 100) -> list[Group]:
    """List the groups, with their robots and people."""
    with fleet.database.reading() as connection:
        names = [name for name in robots.list_groups(connection) if name > after]
        return describe_groups(connection, names[:limit])


@dataclass(frozen=True, slots=True)
class Person:
    """An account; ``groups`` null is all robots, an empty list is none."""

    name: str
    role: Role
    groups: list[str] | None
    must_change: bool
    created: str
    changed: str
    disabled: str | None


def describe_person(user: users.User) -> Person:
    """Return an account in its published form."""
    groups = None if user.groups is None else sorted(user.groups)
    return Person(
        user.name,
        user.role,
        groups,
        user.must_change,
        format_time(user.created_ns),
        format_time(user.changed_ns),
        maybe_time(user.disabled_ns),
    )


@dataclass(frozen=True, slots=True)
class Group:
    """A group, the robots in it, and the people who are restricted to it."""

    name: str
    robots: list[str]
    people: list[str]


def describe_groups(connection: Connection, names: list[str]) -> list[Group]:
    """Return groups with their robots and people."""
    known, people = robots.list_robots(connection), users.list_users(connection)
    return [
        Group(
            name,
            [robot.id for robot in known if name in robot.groups],
            [user.name for user in people if name in (user.groups or ())],
        )
        for name in names
    ]


@dataclass(frozen=True, slots=True)
class Token:
    """A token as it is listed: its secret begins with ``prefix`` and is never shown again."""

    id: str
    name: str
    prefix: str
    scopes: list[str]
    groups: list[str] | None
    created: str
    expires: str
    revoked: str | None
    used: str | None


def find_account(connection: Connection, name: str) -> users.User:
    """Return an account; raises NotFoundError."""
    try:
        return users.find_user(connection, name)
    except UsageError as error:
        raise NotFoundError(error.what) from error


def describe_token(token: tokens.ApiToken) -> Token:
    """Return a token for a list."""
    return Token(
        token.token_id,
        token.name,
        token.prefix,
        sorted(token.scopes),
        None if token.groups is None else sorted(token.groups),
        format_time(token.created_ns),
        format_time(token.expires_ns),
        maybe_time(token.revoked_ns),
        maybe_time(token.used_ns),
    )


def list_tokens(fleet: Services, name: str) -> list[Token]:
    """List the tokens of an account, expired and revoked ones too, newest first."""
    with fleet.database.reading() as connection:
        user = find_account(connection, name)
        return [describe_token(token) for token in tokens.list_tokens(connection, user.user_id)]


def list_sessions(fleet: Services, who: Caller) -> list[OwnSession]:
    """Return one's open sessions, newest first."""
    with fleet.database.reading() as connection:
        user = users.find_user(connection, who.principal.id)
        found = sessions.list_sessions(connection, fleet.clock.wall_ns(), user.user_id)
    return [
        OwnSession(
            one.session_id, format_time(one.created_ns), format_time(one.seen_ns),
            format_time(one.ends_ns), one.address, one.agent, one.session_id == who.session_id,
        )
        for one in found
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A session that lasts; ``id`` revokes it."""

    id: str
    began: str
    seen: str
    ends: str
    address: str
    agent: str


@dataclass(frozen=True, slots=True)
class OwnSession(OpenSession):
    """A session of one's own; ``current`` is the one that asks."""

    current: bool


def list_waiting_keys(fleet: Services) -> list[WaitingKey]:
    """List the keys that robots sign with since, and that no admin has confirmed or refused."""
    with fleet.database.reading() as connection:
        return [
            WaitingKey(key.robot, key.store_id, key.public_key, format_time(key.first_seen_ns))
            for key in link_state.pending_keys(connection)
        ]


@dataclass(frozen=True, slots=True)
class WaitingKey:
    """A key that a robot signs with instead of the one before; it waits for an admin."""

    robot: str
    store_id: str
    public_key: str
    first_seen: str
