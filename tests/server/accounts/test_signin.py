"""Logging in: the right password, twenty wrong ones, and who has to wait for whom."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress

import pytest
from sqlalchemy import select

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.server.accounts.passwords import HashCost, Passwords
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.signin import (
    LIMITS,
    AttemptLimit,
    LoginOrigin,
    MustWaitError,
    WrongLoginError,
    address_key,
    change_password,
    sign_in,
)
from amberbox.server.accounts.users import disable_user
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import KNOWN_ADDRESSES, LOGIN_ATTEMPTS, USERS
from tests.server.accounts.stand import EVIL, HOME, PASSWORD, Stand


def _try(stand: Stand, name: str, address: str, password: str = "wrong") -> str:
    """Try to log in; ``in``, ``wrong``, or how long to wait."""
    try:
        stand.sign_in(name, password, address)
    except WrongLoginError:
        return "wrong"
    except MustWaitError as refused:
        return f"{refused.seconds} s"
    return "in"


def test_a_login_opens_a_session(stand: Stand) -> None:
    stand.add_user("anna", Role.TECHNICIAN)
    session = stand.sign_in("Anna")  # people write their names as they like
    found = stand.whose(session.secret)
    assert found is not None
    assert (found.user.name, found.user.role) == ("anna", Role.TECHNICIAN)
    (row,) = stand.log()
    assert (row.principal, row.address, row.action, row.result) == (
        "user:anna",
        HOME,
        "login",
        "ok",
    )
    assert session.session_id in row.details


def test_it_is_never_said_what_was_wrong(stand: Stand) -> None:
    stand.add_user("root.one", Role.ADMIN)
    stand.add_user("anna")
    stand.add_user("gone")
    with stand.database.begin() as connection:
        disable_user(connection, stand.now_ns, "gone")
    said = set()
    for name, password in (("anna", "wrong"), ("nobody", PASSWORD), ("gone", PASSWORD)):
        with pytest.raises(WrongLoginError) as refused:
            stand.sign_in(name, password)
        said.add(str(refused.value))
    assert len(said) == 1
    told = [(row.object, row.result, row.details) for row in stand.log()]
    assert told == [(name, "refused", '{"why": "wrong login"}') for name in ("anna", "?", "gone")]


def test_twenty_wrong_logins(stand: Stand) -> None:
    """One a second from one address: five are looked at, then one after 2, 4, 8, 16 s."""
    stand.add_user("anna")
    stand.sign_in("anna", address=HOME)
    stand.clock.advance(3600)
    answers = []
    for _ in range(20):
        answers.append(_try(stand, "anna", EVIL))
        stand.clock.advance(1)
    looked_at = [second for second, answer in enumerate(answers) if answer == "wrong"]
    assert looked_at == [0, 1, 2, 3, 4, 6, 10, 18]
    assert answers[7:10] == ["3 s", "2 s", "1 s"]
    assert _try(stand, "anna", EVIL, PASSWORD) == "14 s"  # not even with the right one
    assert _try(stand, "anna", HOME, PASSWORD) == "in"  # its owner does not notice


def test_the_wait_doubles_up_to_a_quarter_of_an_hour(stand: Stand) -> None:
    stand.add_user("anna")
    assert [_try(stand, "anna", EVIL) for _ in range(4)] == ["wrong"] * 4
    waits = []
    for _ in range(12):
        waits.append(int(_try(stand, "anna", EVIL).removesuffix(" s")))
        stand.clock.advance(waits[-1])
        assert _try(stand, "anna", EVIL) == "wrong"
    assert waits == [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 900, 900]


def test_the_wait_outlives_the_server(stand: Stand) -> None:
    stand.add_user("anna")
    while _try(stand, "anna", EVIL) == "wrong":
        pass
    again = ServerDatabase(stand.database.path, stand.clock)
    caller = LoginOrigin(EVIL)
    with pytest.raises(MustWaitError):
        sign_in(again, stand.clock, stand.passwords, "anna", PASSWORD, caller)
    stand.clock.advance(2)
    sign_in(again, stand.clock, stand.passwords, "anna", PASSWORD, caller)
    again.close()


def test_many_attackers_cannot_lock_an_account_for_ever(stand: Stand) -> None:
    """Each from an address of its own: the owner waits 30 s at most, at home not at all."""
    stand.add_user("anna")
    stand.sign_in("anna", address=HOME)
    answers = []
    for number in range(60):
        answers.append(_try(stand, "anna", f"198.51.100.{number}"))
        stand.clock.advance(10)
    assert 20 <= answers.count("wrong") <= 30  # 10 are free, then one in 30 s
    while _try(stand, "anna", "198.51.100.99") != "wrong":
        stand.clock.advance(1)
    assert _try(stand, "anna", "192.0.2.1", PASSWORD) == "30 s"  # somewhere new
    assert _try(stand, "anna", HOME, PASSWORD) == "in"
    stand.clock.advance(30)
    assert _try(stand, "anna", "192.0.2.1", PASSWORD) == "in"


def test_one_password_for_many_accounts_is_slowed_down_too(stand: Stand) -> None:
    answers: Counter[str] = Counter()
    for number in range(40):
        answers["wrong" if _try(stand, f"user{number}", EVIL) == "wrong" else "wait"] += 1
    assert answers["wrong"] == LIMITS["address"].free
    assert _try(stand, "anna", HOME) == "wrong"  # elsewhere nobody waits


def test_an_account_of_ones_own_does_not_clear_the_address(stand: Stand) -> None:
    stand.add_user("eve")
    wrong = 0
    for number in range(40):
        wrong += _try(stand, f"user{number}", EVIL) == "wrong"
        _try(stand, "eve", EVIL, PASSWORD)
    assert wrong <= LIMITS["address"].free


def test_logging_in_rightly_costs_nobody_anything(stand: Stand) -> None:
    stand.add_user("anna")
    stand.add_user("bert")
    for _ in range(25):
        assert _try(stand, "anna", HOME, PASSWORD) == "in"
        assert _try(stand, "bert", HOME, PASSWORD) == "in"


def test_attempts_at_the_same_moment_do_not_slip_through(stand: Stand) -> None:
    """While passwords are being compared, the attempts count as wrong already."""
    stand.add_user("anna")
    looked_at: list[str] = []

    class Nested(Passwords):
        def verify(self, held: str | None, password: str) -> bool:
            looked_at.append(password)
            with suppress(MustWaitError, WrongLoginError):
                sign_in(stand.database, stand.clock, self, "anna", "wrong", LoginOrigin(EVIL))
            return False

    nested = Nested(HashCost(1, 8, 1))
    with pytest.raises(WrongLoginError):
        sign_in(stand.database, stand.clock, nested, "anna", "wrong", LoginOrigin(EVIL))
    nested.close()
    assert len(looked_at) == LIMITS["pair"].free


def test_a_day_later_all_is_forgotten(stand: Stand) -> None:
    stand.add_user("anna")
    for _ in range(12):
        _try(stand, "anna", EVIL)
        stand.clock.advance(200)
    stand.clock.advance(24 * 3600)
    assert [_try(stand, "anna", EVIL) for _ in range(4)] == ["wrong"] * 4
    stand.clock.advance(25 * 3600)
    assert _try(stand, "other", HOME) == "wrong"
    with stand.database.reading() as connection:
        assert len(connection.execute(select(LOGIN_ATTEMPTS)).all()) == 3


def test_a_clock_set_back_locks_nobody_out(stand: Stand) -> None:
    stand.add_user("anna")
    while _try(stand, "anna", EVIL) == "wrong":
        pass
    stand.clock.step(-365 * 24 * 3600)
    assert _try(stand, "anna", EVIL) == "1 s"


def test_the_network_of_a_site_is_one_address() -> None:
    assert (
        address_key("2001:db8:1:2::7") == address_key("2001:db8:1:2:ffff::1") == "2001:db8:1:2::/64"
    )
    assert address_key("2001:db8:1:3::7") != address_key("2001:db8:1:2::7")
    assert address_key("::ffff:10.0.0.7") == address_key("10.0.0.7") == "10.0.0.7"
    assert address_key("fe80::1%eth0") == "fe80::/64"
    assert len(address_key("x" * 500)) == 64


def test_waits() -> None:
    limit = AttemptLimit(free=3, longest_ns=10 * NS)
    waits = [limit.wait_ns(failures) // NS for failures in (0, 2, 3, 4, 5, 6, 7, 10**9)]
    assert waits == [0, 0, 1, 2, 4, 8, 10, 10]


def test_the_log_cannot_be_flooded_by_who_has_to_wait(stand: Stand) -> None:
    stand.add_user("anna")
    answers = [_try(stand, "anna", EVIL) for _ in range(50)]
    rows = stand.log()
    assert Counter(row.details for row in rows) == {
        '{"why": "wrong login"}': answers.count("wrong"),
        '{"why": "too many wrong logins"}': 1,
    }
    assert {(row.principal, row.address, row.result) for row in rows} == {
        ("user:anna", EVIL, "refused")
    }


def test_a_password_in_the_wrong_field_is_not_written_down(stand: Stand) -> None:
    stand.add_user("anna")
    assert _try(stand, "four.quiet.tractors", HOME) == "wrong"
    files = stand.database.path.parent.iterdir()
    assert not any(b"four.quiet" in file.read_bytes() for file in files)
    assert stand.log()[0].principal == "user:?"


def test_a_dearer_hash_is_made_at_the_next_login(stand: Stand) -> None:
    stand.add_user("anna")
    dearer = Passwords(HashCost(passes=2, memory_kib=8, threads=1))
    sign_in(stand.database, stand.clock, dearer, "anna", PASSWORD, LoginOrigin(HOME))
    with stand.database.reading() as connection:
        held = connection.execute(select(USERS.c.password_hash)).scalar_one()
    assert not dearer.is_outdated(held)
    assert dearer.verify(held, PASSWORD)
    dearer.close()


def test_an_account_that_is_closed_meanwhile_is_closed(stand: Stand) -> None:
    stand.add_user("root.one", Role.ADMIN)
    stand.add_user("anna")

    class Slow(Passwords):
        def verify(self, held: str | None, password: str) -> bool:
            with stand.database.begin() as connection:
                disable_user(connection, stand.now_ns, "anna")
            return super().verify(held, password)

    slow = Slow(HashCost(1, 8, 1))
    with pytest.raises(WrongLoginError):
        sign_in(stand.database, stand.clock, slow, "anna", PASSWORD, LoginOrigin(HOME))
    slow.close()


def test_ones_own_password_is_changed_with_the_old_one(stand: Stand) -> None:
    stand.add_user("anna", must_change=True)
    first, second = stand.sign_in(), stand.sign_in()
    new = "nine green kettles whisper"

    def change(old: str, to: str) -> str:
        caller = LoginOrigin(HOME, "Firefox", first.secret)
        return change_password(
            stand.database, stand.clock, stand.passwords, "anna", old, to, caller
        ).secret

    with pytest.raises(WrongLoginError):
        change("wrong", new)
    with pytest.raises(UsageError, match="this password is refused"):
        change(PASSWORD, "anna12345678")
    secret = change(PASSWORD, new)
    found = stand.whose(secret)
    assert found is not None
    assert not found.user.must_change
    assert stand.whose(first.secret) is None
    assert stand.whose(second.secret) is None
    assert _try(stand, "anna", HOME, PASSWORD) == "wrong"
    assert _try(stand, "anna", HOME, new) == "in"
    assert [row.result for row in stand.log() if row.action == "password"] == ["refused", "ok"]


def test_where_somebody_logs_in_is_known_for_a_while(stand: Stand) -> None:
    stand.add_user("anna")
    stand.sign_in(address="2001:db8::7")
    stand.clock.advance(61 * 24 * 3600)
    _try(stand, "anna", EVIL)
    with stand.database.reading() as connection:
        assert connection.execute(select(KNOWN_ADDRESSES)).all() == []
