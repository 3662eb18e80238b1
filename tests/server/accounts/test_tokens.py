"""API tokens: scopes, an end, and never more than their owner."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import pytest
from sqlalchemy import select

from amberbox.core.errors import UsageError
from amberbox.server.accounts.passwords import Secret
from amberbox.server.accounts.permissions import Principal, RobotGroups, Role, allowed
from amberbox.server.accounts.robots import remove_group
from amberbox.server.accounts.tokens import (
    DAY_NS,
    ApiToken,
    TokenUse,
    add_token,
    find_token,
    list_tokens,
    revoke_token,
    touch_token,
)
from amberbox.server.accounts.users import User, disable_user, restrict, set_password, set_role
from amberbox.server.schema import TOKENS
from tests.server.accounts.stand import Stand

ROBOT = RobotGroups("r1", frozenset({"ward"}))


def _add(
    stand: Stand,
    owner: User,
    scopes: Collection[str] = ("read:status",),
    lasts_ns: int = 90 * DAY_NS,
    groups: Iterable[str] | None = None,
) -> Secret:
    with stand.database.begin() as connection:
        return add_token(
            connection, stand.now_ns, owner, "grafana", scopes, lasts_ns, groups=groups
        )


def _use(stand: Stand, secret: Secret | str) -> TokenUse | None:
    text = secret.text if isinstance(secret, Secret) else secret
    with stand.database.reading() as connection:
        return find_token(connection, stand.now_ns, text)


def _principal(stand: Stand, secret: Secret) -> Principal:
    found = _use(stand, secret)
    assert found is not None
    return found.principal


def _listed(stand: Stand, owner: User) -> list[ApiToken]:
    with stand.database.reading() as connection:
        return list_tokens(connection, owner.user_id)


def test_a_token_can_do_what_its_scopes_say(stand: Stand) -> None:
    owner = stand.add_user("anna", Role.TECHNICIAN)
    token = _principal(stand, _add(stand, owner, ["read:status", "write:alarms"]))
    assert allowed(token, "status.read", ROBOT)
    assert allowed(token, "alarms.write", ROBOT)
    for action in ("alarms.read", "data.query", "own.tokens", "own.read", "users.write"):
        assert not allowed(token, action, ROBOT)
    assert str(token) == f"token:{token.id} of anna"


def test_a_token_is_as_weak_as_its_owner_becomes(stand: Stand) -> None:
    stand.add_groups("ward", "lab")
    stand.add_user("root.one", Role.ADMIN)
    owner = stand.add_user("anna", Role.TECHNICIAN)
    secret = _add(stand, owner, ["write:alarms", "read:status"])
    assert allowed(_principal(stand, secret), "alarms.write", ROBOT)
    with stand.database.begin() as connection:
        set_role(connection, "anna", Role.VIEWER)
    assert not allowed(_principal(stand, secret), "alarms.write", ROBOT)
    assert allowed(_principal(stand, secret), "status.read", ROBOT)
    with stand.database.begin() as connection:
        restrict(connection, "anna", ["lab"])
    assert not allowed(_principal(stand, secret), "status.read", ROBOT)
    with stand.database.begin() as connection:
        disable_user(connection, stand.now_ns, "anna")
    assert _use(stand, secret) is None


def test_a_token_is_restricted_to_groups_besides(stand: Stand) -> None:
    stand.add_groups("ward", "lab")
    everywhere = stand.add_user("anna", Role.VIEWER)
    ward = stand.add_user("bert", Role.VIEWER, ["ward"])
    found = [
        _principal(stand, _add(stand, owner, groups=groups)).groups
        for owner in (everywhere, ward)
        for groups in (None, ["lab"], ["ward", "lab"], [])
    ]
    assert found[:4] == [None, {"lab"}, {"ward", "lab"}, frozenset()]
    assert found[4:] == [{"ward"}, frozenset(), {"ward"}, frozenset()]


def test_a_token_whose_group_is_gone_sees_nothing(stand: Stand) -> None:
    stand.add_groups("ward")
    secret = _add(stand, stand.add_user(), groups=["ward"])
    with stand.database.begin() as connection:
        remove_group(connection, "ward")
    assert _principal(stand, secret).groups == frozenset()


def test_an_owner_who_has_to_change_the_password_does_that_first(stand: Stand) -> None:
    secret = _add(stand, stand.add_user())
    with stand.database.begin() as connection:
        set_password(connection, stand.now_ns, "anna", stand.hashed, must_change=True)
    assert _use(stand, secret) is None


def test_a_token_ends(stand: Stand) -> None:
    secret = _add(stand, stand.add_user(), lasts_ns=DAY_NS)
    stand.clock.advance(24 * 3600 - 1)
    assert _use(stand, secret) is not None
    stand.clock.advance(1)
    assert _use(stand, secret) is None
    stand.clock.step(-10 * 24 * 3600)  # by a clock from before it was made
    assert _use(stand, secret) is None


def test_a_token_is_revoked_by_its_owner_only(stand: Stand) -> None:
    anna, bert = stand.add_user("anna"), stand.add_user("bert")
    secret = _add(stand, anna)
    with stand.database.begin() as connection:
        assert not revoke_token(connection, stand.now_ns, bert.user_id, secret.id)
    assert _use(stand, secret) is not None
    with stand.database.begin() as connection:
        assert revoke_token(connection, stand.now_ns, anna.user_id, secret.id)
        assert not revoke_token(connection, stand.now_ns, anna.user_id, secret.id)
    assert _use(stand, secret) is None
    assert [token.revoked_ns for token in _listed(stand, anna)] == [stand.now_ns]


def test_the_list_shows_how_it_begins_and_when_it_was_used(stand: Stand) -> None:
    owner = stand.add_user()
    secret = _add(stand, owner, ["read:data", "read:status", "read:data"])
    (token,) = _listed(stand, owner)
    assert secret.text.startswith(token.prefix)
    assert token.scopes == {"read:data", "read:status"}
    assert token.used_ns is None
    for seconds, noted in ((0, 0), (59, 0), (1, 60)):
        stand.clock.advance(seconds)
        found = _use(stand, secret)
        assert found is not None
        with stand.database.begin() as connection:
            touch_token(connection, stand.now_ns, found.token)
        (token,) = _listed(stand, owner)
        assert token.used_ns == token.created_ns + noted * 1_000_000_000


def test_the_database_holds_nothing_that_opens_anything(stand: Stand) -> None:
    owner = stand.add_user()
    secret = _add(stand, owner)
    with stand.database.reading() as connection:
        held = connection.execute(select(TOKENS.c.hash)).scalar_one()
    files = b"".join(path.read_bytes() for path in stand.database.path.parent.iterdir())
    assert secret.text.encode() not in files
    assert secret.text.rpartition("_")[2] not in repr((secret, _listed(stand, owner)))
    for wrong in (held, secret.id, secret.text[:-1], secret.text + "A", "", secret.text.upper()):
        assert _use(stand, wrong) is None


def test_one_kind_of_secret_does_not_open_another(stand: Stand) -> None:
    secret = _add(stand, stand.add_user())
    assert stand.whose(secret.text) is None
    assert _use(stand, stand.sign_in().secret) is None


@pytest.mark.parametrize(
    ("scopes", "lasts_ns", "what"),
    [
        (["read:statuses"], DAY_NS, "did you mean 'read:status'"),
        (["write:users"], DAY_NS, "there is no scope 'write:users'"),
        ([], DAY_NS, "without scopes"),
        (["read:status"], 0, "at most 366 days"),
        (["read:status"], -1, "at most 366 days"),
        (["read:status"], 367 * DAY_NS, "at most 366 days"),
    ],
)
def test_what_makes_no_token(stand: Stand, scopes: list[str], lasts_ns: int, what: str) -> None:
    owner = stand.add_user()
    with pytest.raises(UsageError, match=what):
        _add(stand, owner, scopes, lasts_ns)
    assert _listed(stand, owner) == []


def test_a_token_has_a_name(stand: Stand) -> None:
    owner = stand.add_user()
    for name in ("", " ", "x" * 101):
        with pytest.raises(UsageError, match="needs a name"), stand.database.begin() as connection:
            add_token(connection, stand.now_ns, owner, name, ["read:status"])
