"""API tokens: what a person gives to a program, with scopes, an end and a name to find it by.

A token can do what its scopes say, and never more than its owner can at that moment.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, RowMapping, insert, select, update

from amberbox.core.clock import NS
from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.fleet.accounts.actions import SCOPES
from amberbox.fleet.accounts.groups import groups_of, set_groups
from amberbox.fleet.accounts.keys import Secret, digest, new_secret
from amberbox.fleet.accounts.principal import Principal
from amberbox.fleet.accounts.tables import TOKEN_GROUPS, TOKENS, USERS
from amberbox.fleet.accounts.users import User, user_of
from amberbox.link.keys import is_secret

DAY_NS = 24 * 3600 * NS
LONGEST_NS = 366 * DAY_NS
_TOUCH_NS = 60 * NS


@dataclass(frozen=True, slots=True)
class Token:
    """A token as it is listed: its secret is never shown again."""

    token_id: str
    name: str
    scopes: frozenset[str]
    groups: frozenset[str] | None
    created_ns: int
    expires_ns: int
    revoked_ns: int | None
    used_ns: int | None

    @property
    def prefix(self) -> str:
        """Return how its secret begins, to find it again in a program's settings."""
        return f"abt_{self.token_id}_"


@dataclass(frozen=True, slots=True)
class TokenUse:
    """Whose request this is, by its token."""

    principal: Principal
    token: Token
    owner: User


def add_token(
    connection: Connection,
    now_ns: int,
    owner: User,
    name: str,
    scopes: Collection[str],
    lasts_ns: int = 90 * DAY_NS,
    *,
    groups: Iterable[str] | None = None,
) -> Secret:
    """Make a token; its secret is in the answer and nowhere else.

    ``groups`` restrict it further than its owner. Raises UsageError for an unknown scope or group,
    no scope, no name, and an end that is no time or more than 366 days off.
    """
    _refuse(name, scopes, lasts_ns)
    secret = new_secret("token")
    row = {
        "token_id": secret.id,
        "hash": secret.hash,
        "user_id": owner.user_id,
        "name": name,
        "scopes": " ".join(sorted(set(scopes))),
        "all_robots": groups is None,
        "created_ns": now_ns,
        "expires_ns": now_ns + lasts_ns,
    }
    connection.execute(insert(TOKENS), [row])
    set_groups(connection, TOKEN_GROUPS, secret.id, groups or ())
    return secret


def find_token(connection: Connection, now_ns: int, secret: str) -> TokenUse | None:
    """Return who asks with a token; None when it is unknown, over, revoked, or its owner's account
    is closed or has to change its password first.
    """
    if not is_secret(secret, "token"):
        return None
    chosen = select(TOKENS).where(TOKENS.c.hash == digest(secret))
    row = connection.execute(chosen).mappings().one_or_none()
    if row is None or row["revoked_ns"] is not None:
        return None
    if not row["created_ns"] - _TOUCH_NS <= now_ns < row["expires_ns"]:
        return None
    owner = _owner(connection, row["user_id"])
    if owner.disabled_ns is not None or owner.must_change:
        return None
    token = _token(connection, row)
    return TokenUse(_principal(token, owner), token, owner)


def _principal(token: Token, owner: User) -> Principal:
    groups = _narrower(owner.groups, token.groups)
    return Principal("token", token.token_id, owner.role, groups, token.scopes, owner=owner.name)


def _narrower(one: frozenset[str] | None, other: frozenset[str] | None) -> frozenset[str] | None:
    if one is None:
        return other
    return one if other is None else one & other


def touch_token(connection: Connection, now_ns: int, token: Token) -> None:
    """Note that a token was used, to the minute."""
    if token.used_ns is None or now_ns - token.used_ns >= _TOUCH_NS:
        chosen = update(TOKENS).where(TOKENS.c.token_id == token.token_id)
        connection.execute(chosen.values(used_ns=now_ns))


def list_tokens(connection: Connection, user_id: int) -> list[Token]:
    """Return the tokens of somebody, also those that are over, newest first."""
    chosen = select(TOKENS).where(TOKENS.c.user_id == user_id)
    ordered = chosen.order_by(TOKENS.c.created_ns.desc(), TOKENS.c.token_id)
    found = connection.execute(ordered).mappings().all()
    return [_token(connection, row) for row in found]


def working_tokens(connection: Connection, now_ns: int) -> dict[str, list[Token]]:
    """Return everybody's tokens that work, by their owners' names, newest first."""
    chosen = select(TOKENS, USERS.c.name.label("owner")).join(
        USERS, USERS.c.user_id == TOKENS.c.user_id
    )
    working = chosen.where(TOKENS.c.revoked_ns.is_(None), TOKENS.c.expires_ns > now_ns)
    ordered = working.order_by(TOKENS.c.created_ns.desc(), TOKENS.c.token_id)
    found: dict[str, list[Token]] = {}
    for row in connection.execute(ordered).mappings().all():
        found.setdefault(row["owner"], []).append(_token(connection, row))
    return found


def revoke_token(connection: Connection, now_ns: int, user_id: int, token_id: str) -> bool:
    """Revoke a token of somebody, at once; False when there is none of that id that works."""
    chosen = update(TOKENS).where(TOKENS.c.token_id == token_id, TOKENS.c.user_id == user_id)
    open_ones = chosen.where(TOKENS.c.revoked_ns.is_(None))
    return bool(connection.execute(open_ones.values(revoked_ns=now_ns)).rowcount)


def revoke_tokens(connection: Connection, now_ns: int, user_id: int) -> int:
    """Revoke all tokens of somebody, at once; return how many there were."""
    chosen = update(TOKENS).where(TOKENS.c.user_id == user_id, TOKENS.c.revoked_ns.is_(None))
    return int(connection.execute(chosen.values(revoked_ns=now_ns)).rowcount)


def _refuse(name: str, scopes: Collection[str], lasts_ns: int) -> None:
    for scope in sorted(scopes):
        if scope not in SCOPES:
            listed = f"scopes are: {', '.join(SCOPES)}"
            raise UsageError(f"there is no scope '{scope}'{did_you_mean(scope, SCOPES)}", listed)
    if not scopes:
        raise UsageError("a token without scopes can do nothing", "name the least it needs")
    if not 0 < len(name.strip()) <= 100:
        raise UsageError("a token needs a name of 1 to 100 characters", "name what will use it")
    if not 0 < lasts_ns <= LONGEST_NS:
        raise UsageError("a token lasts at most 366 days", "make a new one before it ends")


def _owner(connection: Connection, user_id: int) -> User:
    chosen = select(USERS).where(USERS.c.user_id == user_id)
    return user_of(connection, connection.execute(chosen).mappings().one())


def _token(connection: Connection, row: RowMapping) -> Token:
    token_id = row["token_id"]
    return Token(
        token_id,
        row["name"],
        frozenset(row["scopes"].split()),
        None if row["all_robots"] else groups_of(connection, TOKEN_GROUPS, token_id),
        row["created_ns"],
        row["expires_ns"],
        row["revoked_ns"],
        row["used_ns"],
    )
