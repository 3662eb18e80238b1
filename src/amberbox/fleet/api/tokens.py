"""Tokens: what people give to programs. Each sees and revokes their own, admins those of others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import HTTPException
from pydantic import Field, StringConstraints

from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.fleet.accounts import tokens
from amberbox.fleet.accounts.users import User, find_user
from amberbox.fleet.api.access import Caller, Fleet, Routes, Who
from amberbox.fleet.api.forms import Form, Id, Named, shown
from amberbox.fleet.api.users import find
from amberbox.fleet.bus import Change
from amberbox.fleet.services import Services

routes = Routes("tokens")

_MOST = 200
Scope = Annotated[str, Field(max_length=64)]


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


@routes.get("/tokens", "own.read")
def list_own(fleet: Fleet, who: Who) -> list[Token]:
    """List one's own tokens, those that are over too, newest first."""
    return _listed(fleet, who.principal.id)


@routes.post("/tokens", "own.tokens", status_code=201)
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
        told = {"name": new.name, "scopes": new.scopes, "days": new.days, "groups": new.groups}
        who.note(connection, now_ns, "tokens.make", secret.id, details=told)
    return MadeToken(secret.id, secret.text, format_time(now_ns + lasts_ns))


@routes.delete("/tokens/{token}", "own.write", status_code=204)
def revoke_own(fleet: Fleet, who: Who, token: Named) -> None:
    """Revoke one of one's own tokens, at once."""
    _revoke(fleet, who, who.principal.id, token)


@routes.get("/users/{name}/tokens", "users.read")
def list_of(fleet: Fleet, name: Named) -> list[Token]:
    """List the tokens of somebody."""
    return _listed(fleet, name)


@routes.delete("/users/{name}/tokens/{token}", "users.write", status_code=204)
def revoke_of(fleet: Fleet, who: Who, name: Named, token: Named) -> None:
    """Revoke a token of somebody, at once."""
    _revoke(fleet, who, name, token)


def _listed(fleet: Services, name: str) -> list[Token]:
    with fleet.database.reading() as connection:
        user: User = find(connection, name)
        return [_shown(token) for token in tokens.list_tokens(connection, user.user_id)]


def _revoke(fleet: Services, who: Caller, name: str, token: str) -> None:
    with fleet.database.begin() as connection:
        now_ns = fleet.clock.wall_ns()
        user = find(connection, name)
        if not tokens.revoke_token(connection, now_ns, user.user_id, token):
            raise HTTPException(404, "there is no such token that works")
        who.note(connection, now_ns, "tokens.revoke", token, details={"of": name})
    fleet.bus.publish(Change("account", data={"name": name}))


def _refuse_too_many(held: list[tokens.Token], now_ns: int) -> None:
    working = [one for one in held if one.revoked_ns is None and now_ns < one.expires_ns]
    if len(working) >= _MOST:
        raise UsageError(f"there are {len(working)} tokens that work", "revoke some first")


def _refuse_foreign(owner: User, groups: list[str] | None) -> None:
    """Refuse groups that are not the owner's: they would open nothing, and tell which there are."""
    for name in groups or () if owner.groups is not None else ():
        if name not in (owner.groups or ()):
            listed = f"yours are: {', '.join(sorted(owner.groups or ()))}"
            raise UsageError(f"you are not for a group '{name}'", listed)


def _shown(token: tokens.Token) -> Token:
    return Token(
        token.token_id,
        token.name,
        token.prefix,
        sorted(token.scopes),
        None if token.groups is None else sorted(token.groups),
        format_time(token.created_ns),
        format_time(token.expires_ns),
        shown(token.revoked_ns),
        shown(token.used_ns),
    )
