"""The code of the first start: once, half an hour, readable only in the server's folder."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest
from sqlalchemy import select

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.signin import (
    SETUP_FILE,
    LoginOrigin,
    MustWaitError,
    SetupCode,
    WrongCodeError,
    needs_setup,
    new_setup_code,
    set_up_here,
    use_setup_code,
)
from amberbox.server.accounts.users import User, list_users
from amberbox.server.schema import SETUP_CODES
from tests.server.accounts.stand import EVIL, HOME, PASSWORD, Stand


def _new(stand: Stand) -> SetupCode:
    return new_setup_code(stand.database, stand.clock, stand.database.path.parent)


def _use(
    stand: Stand, code: str, name: str = "anna", address: str = HOME, password: str = PASSWORD
) -> User:
    return use_setup_code(
        stand.database,
        stand.clock,
        stand.passwords,
        stand.database.path.parent,
        code,
        name,
        password,
        LoginOrigin(address),
    )


def _here(stand: Stand, name: str) -> User:
    folder = stand.database.path.parent
    caller = LoginOrigin("127.0.0.1")
    return set_up_here(stand.database, stand.clock, stand.passwords, folder, name, PASSWORD, caller)


def _waits(stand: Stand) -> bool:
    with stand.database.reading() as connection:
        return needs_setup(connection)


def test_a_code_makes_the_first_admin(stand: Stand) -> None:
    assert _waits(stand)
    code = _new(stand)
    assert code.path.read_text() == code.code + "\n"
    assert stat.S_IMODE(code.path.stat().st_mode) == 0o600
    user = _use(stand, code.code)
    assert (user.role, user.groups) == (Role.ADMIN, None)
    assert not _waits(stand)
    assert not code.path.exists()
    assert stand.whose(stand.sign_in("anna").secret) is not None
    assert [row.action for row in stand.log()] == ["setup", "setup", "login"]


def test_a_code_is_used_once(stand: Stand) -> None:
    code = _new(stand)
    _use(stand, code.code)
    with pytest.raises(WrongCodeError):
        _use(stand, code.code, "eve")
    with stand.database.reading() as connection:
        assert [user.name for user in list_users(connection)] == ["anna"]


def test_a_code_holds_for_half_an_hour(stand: Stand) -> None:
    code = _new(stand)
    stand.clock.advance(30 * 60)
    with pytest.raises(WrongCodeError):
        _use(stand, code.code)
    code = _new(stand)
    stand.clock.advance(30 * 60 - 1)
    _use(stand, code.code)


def test_a_clock_set_back_does_not_make_a_code_hold_longer(stand: Stand) -> None:
    code = _new(stand)
    stand.clock.step(-1)
    with pytest.raises(WrongCodeError):
        _use(stand, code.code)


def test_a_new_code_replaces_the_old_one(stand: Stand) -> None:
    old, new = _new(stand), _new(stand)
    assert old.path.read_text() == new.code + "\n"
    with pytest.raises(WrongCodeError):
        _use(stand, old.code)
    _use(stand, new.code)


def test_a_code_is_typed_as_people_type(stand: Stand) -> None:
    code = _new(stand).code
    assert len(code.replace("-", "")) == 20
    _use(stand, f" {code.upper().replace('-', ' ').replace('1', 'l').replace('0', 'O')} ")


def test_only_the_hash_is_kept(stand: Stand) -> None:
    code = _new(stand)
    database = stand.database.path
    held = b"".join(path.read_bytes() for path in database.parent.glob(f"{database.name}*"))
    assert code.code.encode() not in held
    with stand.database.reading() as connection:
        hash_ = connection.execute(select(SETUP_CODES.c.hash)).scalar_one()
    with pytest.raises(WrongCodeError):
        _use(stand, hash_)
    assert code.code not in repr(code)


def test_stderr_says_what_to_do(stand: Stand) -> None:
    code = _new(stand)
    text = code.text("https://fleet.example:8443/setup")
    assert all(part in text for part in (code.code, str(code.path), "30 minutes", "/setup"))
    assert "On this machine no code is asked for" in text
    assert "and enter this code" in code.text("https://fleet.example/setup", by_proxy=True)
    _use(stand, code.code)
    assert "and enter this code" in _new(stand).text("https://fleet.example:8443/setup")


def test_a_mistake_does_not_use_up_the_code(stand: Stand) -> None:
    code = _new(stand)
    with pytest.raises(UsageError, match="this password is refused"):
        _use(stand, code.code, password="short")
    with pytest.raises(UsageError, match="not a name"):
        _use(stand, code.code, name="Anna M")
    _use(stand, code.code)


def test_codes_cannot_be_tried_out(stand: Stand) -> None:
    _new(stand)
    tried = 0
    with pytest.raises(MustWaitError):
        for _ in range(100):
            with pytest.raises(WrongCodeError):
                _use(stand, "0000-0000-0000-0000-0000", address=EVIL)
            tried += 1
    assert tried == 4
    assert {row.result for row in stand.log()[1:]} == {"refused"}


def test_at_the_server_itself_the_first_admin_needs_no_code(stand: Stand) -> None:
    code = _new(stand)
    _here(stand, "anna")
    assert not code.path.exists()
    with pytest.raises(WrongCodeError):
        _here(stand, "eve")
    with pytest.raises(WrongCodeError):
        _use(stand, code.code, "eve")
    with stand.database.reading() as connection:
        assert [user.name for user in list_users(connection)] == ["anna"]


def test_an_admin_who_is_locked_out_gets_in_with_a_new_code(stand: Stand) -> None:
    _use(stand, _new(stand).code)
    _use(stand, _new(stand).code, "anna.again")
    with stand.database.reading() as connection:
        assert [user.role for user in list_users(connection)] == [Role.ADMIN, Role.ADMIN]


def test_a_file_of_somebody_else_is_not_written_into(stand: Stand, tmp_path: Path) -> None:
    folder, victim = stand.database.path.parent, tmp_path / "victim"
    victim.write_text("mine")
    (folder / SETUP_FILE).symlink_to(victim)
    code = _new(stand)
    assert victim.read_text() == "mine"
    assert not code.path.is_symlink()


def test_a_folder_that_cannot_be_written(stand: Stand) -> None:
    with pytest.raises(AmberboxError, match="cannot write"):
        new_setup_code(stand.database, stand.clock, Path("nowhere"))
