"""People: who has an account, what they may do, and how they get in again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field
from sqlalchemy import Connection

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts import sessions, users
from amberbox.fleet.accounts.actions import Role
from amberbox.fleet.accounts.onetime import one_time_password
from amberbox.fleet.accounts.tokens import revoke_tokens
from amberbox.fleet.api.access import Fleet, Routes, Who
from amberbox.fleet.api.forms import AfterName, Form, Id, Limit, Named, missing, shown
from amberbox.fleet.api.session import EndedSessions, OpenSession
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services

routes = Routes("people")

Groups = Annotated[list[Id], Field(max_length=200)]


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


@routes.get("/users", "users.read")
def list_people(fleet: Fleet, after: AfterName = "", limit: Limit = 100) -> list[Person]:
    """List the accounts by name, closed ones too."""
    with fleet.database.reading() as connection:
        found = [user for user in users.list_users(connection) if user.name > after]
    return [person(user) for user in found[:limit]]


@routes.post("/users", "users.write", status_code=201)
def add_person(fleet: Fleet, who: Who, new: NewPerson) -> OneTimePassword:
    """Add an account; its one-time password is in the answer and nowhere else."""
    password = one_time_password()
    hashed = fleet.passwords.hash(password)
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        users.add_user(
            connection, now_ns, new.name, new.role, hashed, groups=new.groups, must_change=True
        )
        told = {"role": new.role, "groups": new.groups}
        who.note(connection, now_ns, "users.add", new.name, details=told)
    _tell(fleet, new.name)
    return OneTimePassword(new.name, password)


@routes.get("/users/{name}", "users.read")
def read_person(fleet: Fleet, name: Named) -> Person:
    """Show one account."""
    with fleet.database.reading() as connection:
        return person(find(connection, name))


@routes.patch("/users/{name}", "users.write")
def change_person(fleet: Fleet, who: Who, name: Named, change: ChangedPerson) -> Person:
    """Change role or groups, close or open an account: all of it, or nothing if one is refused."""
    with fleet.database.begin() as connection:
        find(connection, name)
        now_ns = fleet.clock.wall_ns()
        _apply(connection, now_ns, name, change)
        details = change.model_dump(exclude_unset=True, mode="json")
        who.note(connection, now_ns, "users.change", name, details=details)
        changed = person(users.find_user(connection, name))
    _tell(fleet, name)
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


@routes.post("/users/{name}/password", "users.write")
def reset_password(
    fleet: Fleet, who: Who, name: Named, reset: Reset | None = None
) -> OneTimePassword:
    """Give somebody a one-time password; all their sessions end, and their tokens if asked for."""
    if name == who.principal.id:
        raise UsageError("this is your own account", "change your password with the old one")
    password = one_time_password()
    hashed = fleet.passwords.hash(password)
    with fleet.database.begin() as connection:
        user_id, now_ns = find(connection, name).user_id, fleet.clock.wall_ns()
        users.set_password(connection, now_ns, name, hashed, must_change=True)
        details = {}
        if reset is not None and reset.revoke_tokens:
            details = {"tokens_revoked": revoke_tokens(connection, now_ns, user_id)}
        who.note(connection, now_ns, "users.password", name, details=details)
    _tell(fleet, name)
    return OneTimePassword(name, password)


@routes.get("/users/{name}/sessions", "users.read")
def list_logins(fleet: Fleet, name: Named) -> list[OpenSession]:
    """List the open sessions of somebody, newest first."""
    with fleet.database.reading() as connection:
        user = find(connection, name)
        found = sessions.list_sessions(connection, fleet.clock.wall_ns(), user.user_id)
    return [login(session) for session in found]


@routes.delete("/users/{name}/sessions", "users.write")
def end_logins(fleet: Fleet, who: Who, name: Named) -> EndedSessions:
    """End all sessions of somebody."""
    with fleet.database.begin() as connection:
        ended = sessions.revoke_sessions(connection, find(connection, name).user_id)
        details = {"ended": ended}
        who.note(connection, fleet.clock.wall_ns(), "users.sessions.end", name, details=details)
    _tell(fleet, name)
    return EndedSessions(ended)


def find(connection: Connection, name: str) -> users.User:
    """Return an account; raises 404."""
    try:
        return users.find_user(connection, name)
    except UsageError as error:
        raise missing(error) from error


def person(user: users.User) -> Person:
    """Return an account as it is shown."""
    groups = None if user.groups is None else sorted(user.groups)
    return Person(
        user.name,
        user.role,
        groups,
        user.must_change,
        format_time(user.created_ns),
        format_time(user.changed_ns),
        shown(user.disabled_ns),
    )


def login(session: sessions.Session) -> OpenSession:
    """Return a session as it is listed."""
    return OpenSession(
        session.session_id,
        format_time(session.created_ns),
        format_time(session.seen_ns),
        format_time(session.ends_ns),
        session.address,
        session.agent,
    )


def _tell(fleet: Services, name: str) -> None:
    fleet.bus.publish(Change("account", data={"name": name}))
