"""People: accounts, roles, groups, and at least one admin at any time."""

from __future__ import annotations

import pytest

from amberbox.core.errors import UsageError
from amberbox.server.accounts.permissions import Principal, Role
from amberbox.server.accounts.robots import add_group, list_groups, remove_group
from amberbox.server.accounts.signin import WrongLoginError
from amberbox.server.accounts.users import (
    add_user,
    disable_user,
    enable_user,
    find_user,
    has_admin,
    list_users,
    restrict,
    set_password,
    set_role,
)
from tests.server.accounts.stand import PASSWORD, Stand


def test_an_account_is_who_asks(stand: Stand) -> None:
    stand.add_groups("ward")
    stand.add_user("anna", Role.OPERATOR)
    stand.add_user("bert", Role.VIEWER, ["ward"])
    with stand.database.reading() as connection:
        anna, bert = list_users(connection)
    assert anna.principal == Principal("user", "anna", Role.OPERATOR, None)
    assert bert.principal == Principal("user", "bert", Role.VIEWER, frozenset({"ward"}))


@pytest.mark.parametrize("name", ["", "Anna", "an na", "..", "a" * 65, "anna\n", "änna"])
def test_names_are_ids(stand: Stand, name: str) -> None:
    with pytest.raises(UsageError, match="not a name of a person"):
        stand.add_user(name)


def test_names_are_taken_once(stand: Stand) -> None:
    stand.add_user("anna")
    with pytest.raises(UsageError, match="'anna' already"):
        stand.add_user("anna")


def test_a_name_that_is_not_there(stand: Stand) -> None:
    stand.add_user("anna")
    with pytest.raises(UsageError, match="did you mean 'anna'"), stand.database.reading() as reader:
        find_user(reader, "ana")


def test_an_unknown_group_makes_no_account(stand: Stand) -> None:
    stand.add_groups("ward")
    with pytest.raises(UsageError, match="did you mean 'ward'"):
        stand.add_user("anna", groups=["wart"])
    with stand.database.reading() as connection:
        assert list_users(connection) == []


def test_who_loses_the_last_group_sees_nothing(stand: Stand) -> None:
    stand.add_groups("ward")
    stand.add_user("bert", Role.VIEWER, ["ward"])
    with stand.database.begin() as connection:
        remove_group(connection, "ward")
        add_group(connection, stand.now_ns, "ward")  # another one of that name grants nothing
        assert find_user(connection, "bert").groups == frozenset()


def test_groups_that_are_not_there(stand: Stand) -> None:
    stand.add_groups("ward")
    with stand.database.begin() as connection:
        with pytest.raises(UsageError, match="did you mean 'ward'"):
            remove_group(connection, "wards")
        with pytest.raises(UsageError, match="'ward' already"):
            add_group(connection, stand.now_ns, "ward")
        assert list_groups(connection) == ["ward"]


def test_a_role_changes_in_open_sessions(stand: Stand) -> None:
    stand.add_user("root.one", Role.ADMIN)
    stand.add_user("anna", Role.OPERATOR)
    session = stand.sign_in("anna")
    with stand.database.begin() as connection:
        set_role(connection, "anna", Role.VIEWER)
    found = stand.whose(session.secret)
    assert found is not None
    assert found.user.role is Role.VIEWER


def test_a_closed_account_is_out_at_once(stand: Stand) -> None:
    stand.add_user("root.one", Role.ADMIN)
    stand.add_user("anna")
    session = stand.sign_in("anna")
    with stand.database.begin() as connection:
        disable_user(connection, stand.now_ns, "anna")
    assert stand.whose(session.secret) is None
    with pytest.raises(WrongLoginError):
        stand.sign_in("anna")
    with stand.database.begin() as connection:
        enable_user(connection, "anna")
    assert stand.whose(session.secret) is None  # the old session does not come back
    stand.sign_in("anna")


def test_a_new_password_ends_sessions(stand: Stand) -> None:
    stand.add_user("anna")
    session = stand.sign_in("anna")
    hash_ = stand.passwords.hash("nine green kettles whisper")
    with stand.database.begin() as connection:
        set_password(connection, stand.now_ns, "anna", hash_, must_change=True)
    assert stand.whose(session.secret) is None
    with pytest.raises(WrongLoginError):
        stand.sign_in("anna", PASSWORD)
    again = stand.whose(stand.sign_in("anna", "nine green kettles whisper").secret)
    assert again is not None
    assert again.user.principal.must_change


def test_somebody_can_always_administer(stand: Stand) -> None:
    stand.add_groups("ward")
    stand.add_user("one", Role.ADMIN)
    stand.add_user("two", Role.ADMIN, ["ward"])  # for some robots only: does not count
    with pytest.raises(UsageError, match="nobody to admin"), stand.database.begin() as connection:
        disable_user(connection, stand.now_ns, "one")
    with pytest.raises(UsageError, match="nobody to admin"), stand.database.begin() as connection:
        set_role(connection, "one", Role.TECHNICIAN)
    with pytest.raises(UsageError, match="nobody to admin"), stand.database.begin() as connection:
        restrict(connection, "one", ["ward"])
    with stand.database.begin() as connection:
        assert has_admin(connection)
        restrict(connection, "two", None)
        set_role(connection, "one", Role.VIEWER)
        assert [user.role for user in list_users(connection)] == [Role.VIEWER, Role.ADMIN]


def test_a_role_that_is_none_gets_nowhere(stand: Stand) -> None:
    with pytest.raises(ValueError, match="boss"), stand.database.begin() as connection:
        add_user(connection, 1, "eve", Role("boss"), stand.hashed)
