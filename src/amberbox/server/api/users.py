"""Routes of user accounts, groups of robots, and API tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException
from pydantic import Field, StringConstraints
from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time
from amberbox.server.accounts import robots, sessions, tokens, users
from amberbox.server.accounts.passwords import one_time_password
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.tokens import revoke_tokens
from amberbox.server.accounts.users import User, find_user
from amberbox.server.api.session import EndedSessions
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import Fleet, Routes, Who
from amberbox.server.http.forms import AfterName, Form, Id, Limit, Named, not_found
from amberbox.server.services import people
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.people import (
    Group,
    OpenSession,
    Person,
    Token,
    describe_groups,
    describe_person,
    find_account,
)

user_routes = Routes("people")

Groups = Annotated[list[Id], Field(max_length=200)]


@dataclass(frozen=True, slots=True)
class OneTimePassword:
    """A password that works for one login: it has to be changed then. It is shown only here."""

    name: str
    password: str


class NewPerson(Form):
    """Who is added; without ``groups`` for all robots."""

    name: Id
    role: Role
    groups: Groups | None = None


class Reset(Form):
    """Whether all tokens of the person are revoked with the password."""

    revoke_tokens: bool = False


class ChangedPerson(Form):
    """What is to change; what is left out stays. ``groups`` null is for all robots."""

    role: Role | None = None
    groups: Groups | None = None
    disabled: bool | None = None


@user_routes.get("/users", "users.read")
def list_people(fleet: Fleet, after: AfterName = "", limit: Limit = 100) -> list[Person]:
    """List the accounts by name, closed ones too."""
    return people.list_people(fleet, after, limit)


@user_routes.post("/users", "users.write", status_code=201)
def add_person(fleet: Fleet, who: Who, new: NewPerson) -> OneTimePassword:
    """Add an account; its one-time password is in the answer and nowhere else."""
    password = one_time_password()
    hashed = fleet.passwords.hash(password)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        users.add_user(
            connection, now_ns, new.name, new.role, hashed, groups=new.groups, must_change=True
        )
        details = {"role": new.role, "groups": new.groups}
        who.note(connection, now_ns, "users.add", new.name, details=details)
    fleet.bus.publish(ServerChange("account", data={"name": new.name}))
    return OneTimePassword(new.name, password)


@user_routes.get("/users/{name}", "users.read")
def read_person(fleet: Fleet, name: Named) -> Person:
    """Show one account."""
    with fleet.database.reading() as connection:
        return describe_person(find_account(connection, name))


@user_routes.patch("/users/{name}", "users.write")
def change_person(fleet: Fleet, who: Who, name: Named, change: ChangedPerson) -> Person:
    """Change role or groups, close or open an account: all of it, or nothing if one is refused."""
    with fleet.database.begin() as connection:
        find_account(connection, name)
        now_ns = fleet.clock.wall_ns()
        _apply(connection, now_ns, name, change)
        details = change.model_dump(exclude_unset=True, mode="json")
        who.note(connection, now_ns, "users.change", name, details=details)
        changed = describe_person(users.find_user(connection, name))
    fleet.bus.publish(ServerChange("account", data={"name": name}))
    return changed


def _apply(connection: Connection, now_ns: int, name: str, change: ChangedPerson) -> None:
    if change.role is not None:
        users.set_role(connection, name, change.role)
    if "groups" in change.model_fields_set:
        users.restrict(connection, name, change.groups)
    if change.disabled is True:
        users.disable_user(connection, now_ns, name)
    if change.disabled is False:
        users.enable_user(connection, name)


@user_routes.post("/users/{name}/password", "users.write")
def reset_password(
    fleet: Fleet, who: Who, name: Named, reset: Reset | None = None
) -> OneTimePassword:
    """Give somebody a one-time password; all their sessions end, and their tokens if asked for."""
    if name == who.principal.id:
        raise UsageError("this is your own account", "change your password with the old one")
    password = one_time_password()
    hashed = fleet.passwords.hash(password)
    with fleet.database.begin() as connection:
        user_id, now_ns = find_account(connection, name).user_id, fleet.clock.wall_ns()
        users.set_password(connection, now_ns, name, hashed, must_change=True)
        details = {}
        if reset is not None and reset.revoke_tokens:
            details = {"tokens_revoked": revoke_tokens(connection, now_ns, user_id)}
        who.note(connection, now_ns, "users.password", name, details=details)
    fleet.bus.publish(ServerChange("account", data={"name": name}))
    return OneTimePassword(name, password)


@user_routes.get("/users/{name}/sessions", "users.read")
def list_logins(fleet: Fleet, name: Named) -> list[OpenSession]:
    """List the open sessions of somebody, newest first."""
    with fleet.database.reading() as connection:
        user = find_account(connection, name)
        found = sessions.list_sessions(connection, fleet.clock.wall_ns(), user.user_id)
    return [login(session) for session in found]


@user_routes.delete("/users/{name}/sessions", "users.write")
def end_logins(fleet: Fleet, who: Who, name: Named) -> EndedSessions:
    """End all sessions of somebody."""
    with fleet.database.begin() as connection:
        ended = sessions.revoke_sessions(connection, find_account(connection, name).user_id)
        details = {"ended": ended}
        who.note(connection, fleet.clock.wall_ns(), "users.sessions.end", name, details=details)
    fleet.bus.publish(ServerChange("account", data={"name": name}))
    return EndedSessions(ended)


def login(session: sessions.Session) -> OpenSession:
    """Return a session for a list."""
    return OpenSession(
        session.session_id,
        format_time(session.created_ns),
        format_time(session.seen_ns),
        format_time(session.ends_ns),
        session.address,
        session.agent,
    )


group_routes = Routes("groups")


class NewGroup(Form):
    """The name of a group that is to be."""

    name: Id


@group_routes.get("/groups", "users.read")
def list_groups(fleet: Fleet, after: AfterName = "", limit: Limit = 100) -> list[Group]:
    """List the groups, with their robots and people."""
    return people.list_groups(fleet, after, limit)


@group_routes.post("/groups", "users.write", status_code=201)
def add_group(fleet: Fleet, who: Who, new: NewGroup) -> Group:
    """Add a group; nobody and nothing is in it yet."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        robots.add_group(connection, now_ns, new.name)
        who.note(connection, now_ns, "groups.add", new.name)
    return Group(new.name, [], [])


@group_routes.delete("/groups/{name}", "users.write")
def remove_group(fleet: Fleet, who: Who, name: Named) -> Group:
    """Remove a group; return who and what was in it. Those restricted to it alone see no robot."""
    with fleet.database.begin() as connection:
        before = describe_groups(connection, [name])[0]
        try:
            robots.remove_group(connection, name)
        except UsageError as error:
            raise not_found(error) from error
        details = {"robots": before.robots, "people": before.people}
        who.note(connection, fleet.clock.wall_ns(), "groups.remove", name, details=details)
    for robot in before.robots:
        fleet.bus.publish(ServerChange("robot", robot))
    for person_ in before.people:
        fleet.bus.publish(ServerChange("account", data={"name": person_}))
    return before


token_routes = Routes("tokens")

_MOST = 200
Scope = Annotated[str, Field(max_length=64)]


@dataclass(frozen=True, slots=True)
class MadeToken:
    """A new token; ``token`` is its secret, shown only here."""

    id: str
    token: str
    expires: str


class NewToken(Form):
    """What a program is to be allowed; ``groups`` restrict it further than its owner is."""

    name: Annotated[str, StringConstraints(min_length=1, max_length=100)]
    scopes: Annotated[
        list[Annotated[str, Field(max_length=64)]], Field(min_length=1, max_length=50)
    ]
    days: Annotated[int, Field(ge=1, le=366)] = 90
    groups: Annotated[list[Id], Field(max_length=200)] | None = None


@token_routes.get("/tokens", "own.read")
def list_own(fleet: Fleet, who: Who) -> list[Token]:
    """List one's own tokens, those that are over too, newest first."""
    return people.list_tokens(fleet, who.principal.id)


@token_routes.post("/tokens", "own.tokens", status_code=201)
def make(fleet: Fleet, who: Who, new: NewToken) -> MadeToken:
    """Make a token for a program; its secret is in the answer and nowhere else."""
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        owner = find_user(connection, who.principal.id)
        _refuse_foreign(owner, new.groups)
        _refuse_too_many(tokens.list_tokens(connection, owner.user_id), now_ns)
        lasts_ns = new.days * tokens.DAY_NS
        secret = tokens.add_token(
            connection, now_ns, owner, new.name, new.scopes, lasts_ns, groups=new.groups
        )
        details = {"name": new.name, "scopes": new.scopes, "days": new.days, "groups": new.groups}
        who.note(connection, now_ns, "tokens.make", secret.id, details=details)
    return MadeToken(secret.id, secret.text, format_time(now_ns + lasts_ns))


@token_routes.delete("/tokens/{token}", "own.write", status_code=204)
def revoke_own(fleet: Fleet, who: Who, token: Named) -> None:
    """Revoke one of one's own tokens, at once."""
    _revoke(fleet, who, who.principal.id, token)


@token_routes.get("/users/{name}/tokens", "users.read")
def list_of(fleet: Fleet, name: Named) -> list[Token]:
    """List the tokens of somebody."""
    return people.list_tokens(fleet, name)


@token_routes.delete("/users/{name}/tokens/{token}", "users.write", status_code=204)
def revoke_of(fleet: Fleet, who: Who, name: Named, token: Named) -> None:
    """Revoke a token of somebody, at once."""
    _revoke(fleet, who, name, token)


def _revoke(fleet: Services, who: Caller, name: str, token: str) -> None:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        user = find_account(connection, name)
        if not tokens.revoke_token(connection, now_ns, user.user_id, token):
            raise HTTPException(404, "there is no such token that works")
        who.note(connection, now_ns, "tokens.revoke", token, details={"of": name})
    fleet.bus.publish(ServerChange("account", data={"name": name}))


def _refuse_too_many(held: list[tokens.ApiToken], now_ns: int) -> None:
    working = [one for one in held if one.revoked_ns is None and now_ns < one.expires_ns]
    if len(working) >= _MOST:
        raise UsageError(f"there are {len(working)} tokens that work", "revoke some first")


def _refuse_foreign(owner: User, groups: list[str] | None) -> None:
    """Refuse groups that the owner does not have: they would grant nothing, and reveal
    their names.
    """
    for name in groups or () if owner.groups is not None else ():
        if name not in (owner.groups or ()):
            listed = f"yours are: {', '.join(sorted(owner.groups or ()))}"
            raise UsageError(f"you are not for a group '{name}'", listed)
