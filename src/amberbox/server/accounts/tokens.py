"""API tokens: credentials of programs, with a name, scopes and an end."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from sqlalchemy import Connection, RowMapping, insert, select, update

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.link.join_line import is_secret
from amberbox.server.accounts.passwords import Secret, digest, new_secret
from amberbox.server.accounts.permissions import SCOPES, Principal
from amberbox.server.accounts.robots import groups_of, set_groups
from amberbox.server.accounts.users import User, user_of
from amberbox.server.schema import TOKEN_GROUPS, TOKENS, USERS

DAY_NS = 24 * 3600 * NS
LONGEST_NS = 366 * DAY_NS
_TOUCH_NS = 60 * NS


@dataclass(frozen=True, slots=True)
class ApiToken:
    """A token in a list, without its secret."""

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
        """Return the beginning of its secret, to find it in a program's settings."""
        return f"abt_{self.token_id}_"


@dataclass(frozen=True, slots=True)
class TokenUse:
    """An authenticated token, its owner, and the principal they make."""

    principal: Principal
    token: ApiToken
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
    """Add a token; its secret is only in the returned value.

    ``groups`` restrict it further than its owner. Raises UsageError for an unknown scope or group,
    no scope, no name, and a lifetime that is not positive or longer than 366 days.
    """
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
    """Return token and owner of a secret; None when it is unknown, expired or revoked.

    None also if the owner's account is closed or has to change its password first.
    """
    if not is_secret(secret, "token"):
        return None
    chosen = select(TOKENS).where(TOKENS.c.hash == digest(secret))
    row = connection.execute(chosen).mappings().one_or_none()
    if row is None or row["revoked_ns"] is not None:
        return None
    if not row["created_ns"] - _TOUCH_NS <= now_ns < row["expires_ns"]:
        return None
    owned = select(USERS).where(USERS.c.user_id == row["user_id"])
    owner = user_of(connection, connection.execute(owned).mappings().one())
    if owner.disabled_ns is not None or owner.must_change:
        return None
    token = _token(connection, row)
    limits = [groups for groups in (owner.groups, token.groups) if groups is not None]
    groups = frozenset.intersection(*limits) if limits else None
    principal = Principal(
        "token", token.token_id, owner.role, groups, token.scopes, owner=owner.name
    )
    return TokenUse(principal, token, owner)


def touch_token(connection: Connection, now_ns: int, token: ApiToken) -> None:
    """Store when a token was last used, at most once a minute."""
    if token.used_ns is None or now_ns - token.used_ns >= _TOUCH_NS:
        chosen = update(TOKENS).where(TOKENS.c.token_id == token.token_id)
        connection.execute(chosen.values(used_ns=now_ns))


def list_tokens(connection: Connection, user_id: int) -> list[ApiToken]:
    """Return the tokens of an account, expired and revoked ones too, newest first."""
    chosen = select(TOKENS).where(TOKENS.c.user_id == user_id)
    ordered = chosen.order_by(TOKENS.c.created_ns.desc(), TOKENS.c.token_id)
    found = connection.execute(ordered).mappings().all()
    return [_token(connection, row) for row in found]


def working_tokens(connection: Connection, now_ns: int) -> dict[str, list[ApiToken]]:
    """Return all valid tokens by the names of their owners, newest first."""
    chosen = select(TOKENS, USERS.c.name.label("owner")).join(
        USERS, USERS.c.user_id == TOKENS.c.user_id
    )
    working = chosen.where(TOKENS.c.revoked_ns.is_(None), TOKENS.c.expires_ns > now_ns)
    ordered = working.order_by(TOKENS.c.created_ns.desc(), TOKENS.c.token_id)
    found: dict[str, list[ApiToken]] = {}
    for row in connection.execute(ordered).mappings().all():
        found.setdefault(row["owner"], []).append(_token(connection, row))
    return found


def revoke_token(connection: Connection, now_ns: int, user_id: int, token_id: str) -> bool:
    """Revoke a token of an account; return False when there is none to revoke."""
    chosen = update(TOKENS).where(TOKENS.c.token_id == token_id, TOKENS.c.user_id == user_id)
    open_ones = chosen.where(TOKENS.c.revoked_ns.is_(None))
    return bool(connection.execute(open_ones.values(revoked_ns=now_ns)).rowcount)


def revoke_tokens(connection: Connection, now_ns: int, user_id: int) -> int:
    """Revoke all tokens of an account; return how many were not revoked before."""
    chosen = update(TOKENS).where(TOKENS.c.user_id == user_id, TOKENS.c.revoked_ns.is_(None))
    return int(connection.execute(chosen.values(revoked_ns=now_ns)).rowcount)


def _token(connection: Connection, row: RowMapping) -> ApiToken:
    token_id = row["token_id"]
    return ApiToken(
        token_id,
        row["name"],
        frozenset(row["scopes"].split()),
        None if row["all_robots"] else groups_of(connection, TOKEN_GROUPS, token_id),
        row["created_ns"],
        row["expires_ns"],
        row["revoked_ns"],
        row["used_ns"],
    )
