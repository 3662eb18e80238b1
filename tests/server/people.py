"""The principals in ``roles.yaml``, as clients of the server."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.server.accounts.permissions import SCOPES, Role
from amberbox.server.accounts.robots import enable_robot, rotate_key
from amberbox.server.accounts.sessions import IDLE_NS, begin_session, csrf_token
from amberbox.server.accounts.tokens import add_token, revoke_token
from amberbox.server.accounts.users import add_user, find_user
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from tests.server.house import PASSWORD, URL, House

VICTIM = "somebody"
"""The account that admins change in tests, so that no calling account is changed meanwhile."""

_PEOPLE: Mapping[str, tuple[Role, Collection[str] | None]] = {
    "ward_admin": (Role.ADMIN, ["ward"]),
    "kitchen_admin": (Role.ADMIN, ["kitchen"]),
    "nowhere_admin": (Role.ADMIN, []),
    VICTIM: (Role.VIEWER, None),
}
_SIGNED_IN = ("viewer", "operator", "technician", "admin", "nurse", "newcomer", *_PEOPLE)
_TOKENS: Mapping[str, tuple[str, list[str] | None]] = {
    "token": ("admin", None),
    "other_token": ("admin", None),
    "viewers_token": ("viewer", None),
    "kitchen_token": ("admin", ["kitchen"]),
    "revoked": ("admin", None),
}
_KEYS = {
    "robot": ("ropod_001", "ropod_001"),
    "other_robot": ("ropod_002", "ropod_002"),
    "stranger": ("ropod_001", "ropod_002"),
}


def settle(home: House) -> None:
    """Add the people whom a house does not have anyway."""
    hashed = home.passwords.hash(PASSWORD)
    with home.services.database.begin() as connection:
        now_ns = home.clock.wall_ns()
        for name, (role, groups) in _PEOPLE.items():
            add_user(connection, now_ns, name, role, hashed, groups=groups)
        add_user(connection, now_ns, "newcomer", Role.ADMIN, hashed, must_change=True)


def headers_of(home: House, principal: str, scope: str | None) -> dict[str, str]:
    """Return what a principal sends: each time a new session, token or key."""
    if principal == "nobody":
        return {}
    if principal in _TOKENS:
        return _token(home, principal, scope)
    if principal in _KEYS:
        return _key(home, *_KEYS[principal])
    if principal == "expired":
        return _session(home, "admin", IDLE_NS + NS)
    assert principal in _SIGNED_IN, principal
    return _session(home, principal, 0)


def page(home: House, headers: Mapping[str, str]) -> TestClient:
    """Return a client that sends these, and does not keep cookies of answers."""
    client = TestClient(home.app, base_url=URL, raise_server_exceptions=False)
    client.headers.update(headers)
    return client


def _session(home: House, name: str, age_ns: int) -> dict[str, str]:
    with home.services.database.begin() as connection:
        began_ns = home.clock.wall_ns() - age_ns
        user = find_user(connection, name)
        secret = begin_session(connection, began_ns, user.user_id, "192.0.2.1", "tests").secret
    return {"Cookie": f"{COOKIE}={secret}", CSRF_HEADER: csrf_token(secret)}


def _token(home: House, principal: str, scope: str | None) -> dict[str, str]:
    owner, groups = _TOKENS[principal]
    scopes = set(SCOPES) if scope is None or principal == "revoked" else {scope}
    if principal == "other_token":
        scopes = set(SCOPES) - {scope}
    with home.services.database.begin() as connection:
        now_ns = home.clock.wall_ns()
        user = find_user(connection, owner)
        token = add_token(connection, now_ns, user, "test", scopes, groups=groups)
        if principal == "revoked":
            revoke_token(connection, now_ns, user.user_id, token.id)
    return {"Authorization": f"Bearer {token.text}"}


def _key(home: House, name: str, owner: str) -> dict[str, str]:
    with home.services.database.begin() as connection:
        enable_robot(connection, owner)
        key = rotate_key(connection, home.clock.wall_ns(), owner)
    return {"Authorization": f"Robot {name}:{key.text}"}
