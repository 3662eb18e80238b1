"""Robots and their keys: one each, replaced with an overlap, revoked at once, for itself only."""

from __future__ import annotations

import pytest
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.server.accounts.passwords import Secret
from amberbox.server.accounts.permissions import Principal, RobotGroups, allowed
from amberbox.server.accounts.robots import (
    RobotUse,
    add_robot,
    disable_robot,
    enable_robot,
    find_robot,
    find_robot_key,
    key_works,
    list_keys,
    list_robots,
    read_authorization,
    regroup_robot,
    remove_group,
    revoke_keys,
    rotate_key,
    touch_key,
)
from amberbox.server.schema import ROBOT_KEYS
from tests.server.accounts.stand import Stand


def _add(stand: Stand, robot: str = "r1", *groups: str) -> Secret:
    with stand.database.begin() as connection:
        return add_robot(connection, stand.now_ns, robot, groups)


def _use(stand: Stand, robot: str, key: str) -> RobotUse | None:
    with stand.database.reading() as connection:
        return find_robot_key(connection, stand.now_ns, robot, key)


def _works(stand: Stand, secret: Secret) -> bool:
    with stand.database.reading() as connection:
        is_open = key_works(connection, stand.now_ns, secret.id)
        found = find_robot_key(connection, stand.now_ns, "r1", secret.text)
    assert (found is not None) is is_open
    return is_open


def test_a_robot_is_itself_and_no_other(stand: Stand) -> None:
    """Robot A writing as B, with its own key or with B's name before it."""
    stand.add_groups("ward")
    first, second = _add(stand, "r1", "ward"), _add(stand, "r2", "ward")
    found = _use(stand, "r1", first.text)
    assert found is not None
    assert found.principal == Principal("robot", "r1")
    assert _use(stand, "r2", first.text) is None
    assert _use(stand, "r1", second.text) is None
    with stand.database.reading() as connection:
        robots = {one.id: one.robot for one in list_robots(connection)}
    assert robots["r2"] == RobotGroups("r2", frozenset({"ward"}))
    assert allowed(found.principal, "journals.upload", robots["r1"])
    assert not allowed(found.principal, "journals.upload", robots["r2"])
    assert not allowed(found.principal, "status.read", robots["r1"])


def test_keys_that_were_never_given(stand: Stand) -> None:
    secret = _add(stand)
    with stand.database.reading() as connection:
        held = connection.execute(select(ROBOT_KEYS.c.hash)).scalar_one()
    for wrong in ("", held, secret.id, secret.text[:-1], secret.text.swapcase(), "é", "\ud800"):
        assert _use(stand, "r1", wrong) is None
    files = b"".join(path.read_bytes() for path in stand.database.path.parent.iterdir())
    assert secret.text.encode() not in files


def test_a_key_is_replaced_with_an_overlap(stand: Stand) -> None:
    old = _add(stand)
    with stand.database.begin() as connection:
        new = rotate_key(connection, stand.now_ns, "r1", 3600 * NS)
    assert _works(stand, old)
    assert _works(stand, new)
    stand.clock.advance(3599)
    assert _works(stand, old)
    stand.clock.advance(1)
    assert not _works(stand, old)
    assert _works(stand, new)


def test_a_second_replacement_does_not_make_an_old_key_last_longer(stand: Stand) -> None:
    oldest = _add(stand)
    with stand.database.begin() as connection:
        rotate_key(connection, stand.now_ns, "r1", 60 * NS)
        newest = rotate_key(connection, stand.now_ns, "r1", 3600 * NS)
    stand.clock.advance(61)
    assert not _works(stand, oldest)
    assert _works(stand, newest)
    with stand.database.begin() as connection:
        rotate_key(connection, stand.now_ns, "r1", 0)
    assert not _works(stand, newest)


def test_a_stolen_key_is_revoked_at_once(stand: Stand) -> None:
    old = _add(stand)
    with stand.database.begin() as connection:
        new = rotate_key(connection, stand.now_ns, "r1")
        assert revoke_keys(connection, stand.now_ns, "r1", old.id) == 1
    assert (_works(stand, old), _works(stand, new)) == (False, True)
    with stand.database.begin() as connection:
        assert revoke_keys(connection, stand.now_ns, "r1") == 1
        assert revoke_keys(connection, stand.now_ns, "r1") == 0
    assert not _works(stand, new)


def test_keys_of_one_robot_leave_those_of_another_alone(stand: Stand) -> None:
    _add(stand)
    other = _add(stand, "r2")
    with stand.database.begin() as connection:
        assert revoke_keys(connection, stand.now_ns, "r1", other.id) == 0
        rotate_key(connection, stand.now_ns, "r1", 0)
        revoke_keys(connection, stand.now_ns, "r1")
    assert _use(stand, "r2", other.text) is not None


def test_a_disabled_robot_is_out_whatever_key_it_has(stand: Stand) -> None:
    secret = _add(stand)
    with stand.database.begin() as connection:
        disable_robot(connection, stand.now_ns, "r1")
    assert not _works(stand, secret)
    with stand.database.begin() as connection:
        enable_robot(connection, "r1")
    assert _works(stand, secret)


def test_the_list_says_when_a_key_was_used(stand: Stand) -> None:
    secret = _add(stand)
    start_ns = stand.now_ns
    for seconds, noted in ((0, 0), (59, 0), (1, 60)):
        stand.clock.advance(seconds)
        found = _use(stand, "r1", secret.text)
        assert found is not None
        with stand.database.begin() as connection:
            touch_key(connection, stand.now_ns, found.key)
            (key,) = list_keys(connection, "r1")
        assert (key.key_id, key.used_ns) == (secret.id, start_ns + noted * NS)
    assert secret.text not in repr(key)


def test_robots_are_known_once_and_by_name(stand: Stand) -> None:
    _add(stand, "ropod_001")
    with pytest.raises(UsageError, match="'ropod_001' is known already"):
        _add(stand, "ropod_001")
    with pytest.raises(UsageError, match="not a name of a robot"):
        _add(stand, "../ropod")
    with pytest.raises(UsageError, match="did you mean 'ropod_001'"), stand.database.begin() as c:
        rotate_key(c, stand.now_ns, "ropod_01")


def test_a_robot_that_cannot_be_added_gets_no_key(stand: Stand) -> None:
    with pytest.raises(UsageError, match="there is no group 'ward'"):
        _add(stand, "r1", "ward")
    with stand.database.reading() as connection:
        assert list_robots(connection) == []
        assert list_keys(connection, "r1") == []


def test_groups_of_robots_change(stand: Stand) -> None:
    stand.add_groups("ward", "lab")
    _add(stand, "r1", "ward")
    _add(stand, "r2")
    with stand.database.begin() as connection:
        regroup_robot(connection, "r1", ["ward", "lab"])
        assert find_robot(connection, "r1").groups == {"ward", "lab"}
        remove_group(connection, "ward")
        assert [one.groups for one in list_robots(connection)] == [{"lab"}, frozenset()]


@pytest.mark.parametrize(
    ("header", "found"),
    [
        ("Robot r1:abr_x", ("r1", "abr_x")),
        ("robot  r1:a:b ", ("r1", "a:b")),
        ("Bearer r1:key", None),
        ("Robot r1", None),
        ("Robot :key", None),
        ("Robot r1:", None),
        ("Robotr1:key", None),
        ("", None),
    ],
)
def test_the_header(header: str, found: tuple[str, str] | None) -> None:
    assert read_authorization(header) == found
