"""Sessions: begun by the server, ended by time, people and admins, in any order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from amberbox.core.clock import NS
from amberbox.server.accounts.passwords import new_secret
from amberbox.server.accounts.permissions import Role
from amberbox.server.accounts.sessions import (
    IDLE_NS,
    LONGEST_NS,
    begin_session,
    csrf_token,
    end_session,
    find_session,
    is_csrf_token,
    list_sessions,
    needs_touch,
    revoke_session,
    revoke_sessions,
    touch_session,
)
from amberbox.server.accounts.users import User, add_user, disable_user
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import SESSIONS
from amberbox.testing.clock import ManualClock
from tests.server.accounts.stand import EVIL, HOME, Stand


def _touch(stand: Stand, secret: str) -> None:
    found = stand.whose(secret)
    assert found is not None
    with stand.database.begin() as connection:
        touch_session(connection, stand.now_ns, found.session.session_id)


def test_a_session_ends_after_half_an_hour_of_silence(stand: Stand) -> None:
    stand.add_user()
    secret = stand.sign_in().secret
    stand.clock.advance(29 * 60 + 59)
    assert stand.whose(secret) is not None
    _touch(stand, secret)
    stand.clock.advance(29 * 60 + 59)
    assert stand.whose(secret) is not None
    stand.clock.advance(1)
    assert stand.whose(secret) is None


def test_a_session_ends_after_twelve_hours_at_work(stand: Stand) -> None:
    stand.add_user()
    secret = stand.sign_in().secret
    for _ in range(12 * 4 - 1):
        stand.clock.advance(15 * 60)
        _touch(stand, secret)
    stand.clock.advance(15 * 60 - 1)
    assert stand.whose(secret) is not None
    stand.clock.advance(1)
    assert stand.whose(secret) is None


def test_a_clock_set_back_does_not_make_sessions_longer(stand: Stand) -> None:
    stand.add_user()
    secret = stand.sign_in().secret
    stand.clock.step(-30)
    assert stand.whose(secret) is not None
    stand.clock.step(-3600)
    assert stand.whose(secret) is None


def test_a_session_that_an_attacker_planted_is_worth_nothing(stand: Stand) -> None:
    """Session fixation: the browser of the victim logs in with what the attacker gave it."""
    stand.add_user("anna")
    stand.add_user("eve")
    planted = new_secret("session").text
    own = stand.sign_in("eve", address=EVIL)
    for before in (planted, own.secret):
        session = stand.sign_in("anna", before=before)
        assert session.secret != before
        assert stand.whose(before) is None


def test_every_login_makes_another_session_and_ends_the_one_before(stand: Stand) -> None:
    stand.add_user()
    first = stand.sign_in()
    second = stand.sign_in(before=first.secret)
    assert stand.whose(first.secret) is None
    assert stand.whose(second.secret) is not None


@pytest.mark.parametrize("secret", ["", "abs_", "x" * 61, "abs_" + "0" * 12 + "_" + "A" * 43, "é"])
def test_made_up_secrets_open_nothing(stand: Stand, secret: str) -> None:
    stand.add_user()
    stand.sign_in()
    assert stand.whose(secret) is None


def test_the_database_holds_nothing_that_opens_a_session(stand: Stand) -> None:
    user = stand.add_user()
    session = stand.sign_in()
    with stand.database.reading() as connection:
        held = connection.execute(SESSIONS.select()).mappings().one()
        listed = list_sessions(connection, stand.now_ns, user.user_id)
    assert stand.whose(held["hash"]) is None
    assert stand.whose(session.session_id) is None
    stored = b"".join(path.read_bytes() for path in stand.database.path.parent.iterdir())
    assert session.secret.encode() not in stored
    assert session.secret.split("_", 2)[2] not in repr((session, listed))


def test_sessions_are_listed_and_revoked_one_by_one(stand: Stand) -> None:
    anna, bert = stand.add_user("anna"), stand.add_user("bert")
    first = stand.sign_in("anna")
    stand.clock.advance(60)
    second = stand.sign_in("anna", address="10.0.0.8")
    with stand.database.begin() as connection:
        listed = list_sessions(connection, stand.now_ns, anna.user_id)
        assert [one.address for one in listed] == ["10.0.0.8", HOME]
        assert [one.agent for one in listed] == ["Firefox", "Firefox"]
        touch_session(connection, stand.now_ns + NS, first.session_id)
        listed = list_sessions(connection, stand.now_ns, anna.user_id)
        times = [(one.created_ns, one.seen_ns) for one in listed]
        start_ns = stand.now_ns - 60 * NS
        assert times == [(stand.now_ns, stand.now_ns), (start_ns, stand.now_ns + NS)]
        assert not revoke_session(connection, bert.user_id, first.session_id)
        assert revoke_session(connection, anna.user_id, first.session_id)
        assert not revoke_session(connection, anna.user_id, first.session_id)
    assert stand.whose(first.secret) is None
    assert stand.whose(second.secret) is not None


def test_all_sessions_but_this_one_are_revoked(stand: Stand) -> None:
    user = stand.add_user()
    sessions = [stand.sign_in() for _ in range(3)]
    with stand.database.begin() as connection:
        assert revoke_sessions(connection, user.user_id, but=sessions[1].session_id) == 2
    assert [stand.whose(one.secret) is not None for one in sessions] == [False, True, False]


def test_a_session_of_a_closed_account_opens_nothing(stand: Stand) -> None:
    """Also one that was begun in the same moment as the account was closed."""
    stand.add_user("root.one", Role.ADMIN)
    user = stand.add_user("anna")
    with stand.database.begin() as connection:
        disable_user(connection, stand.now_ns, "anna")
        session = begin_session(connection, stand.now_ns, user.user_id, HOME)
    assert stand.whose(session.secret) is None


def test_a_request_is_noted_every_half_minute(stand: Stand) -> None:
    stand.add_user()
    found = stand.whose(stand.sign_in().secret)
    assert found is not None
    assert not needs_touch(found.session, stand.now_ns + 29 * NS)
    assert needs_touch(found.session, stand.now_ns + 30 * NS)


def test_forms_belong_to_one_session(stand: Stand) -> None:
    stand.add_user()
    first, second = stand.sign_in().secret, stand.sign_in().secret
    assert is_csrf_token(first, csrf_token(first))
    assert not is_csrf_token(second, csrf_token(first))
    for wrong in ("", csrf_token(first)[:-1], "é" * 64, "\ud800"):
        assert not is_csrf_token(first, wrong)


def test_sessions_that_are_over_are_cleared_away(stand: Stand) -> None:
    stand.add_user()
    stand.sign_in()
    stand.clock.advance(31 * 60)
    last = stand.sign_in()
    with stand.database.reading() as connection:
        held = connection.execute(SESSIONS.select()).mappings().all()
    assert [row["session_id"] for row in held] == [last.session_id]


@dataclass
class _Model:
    """What a session should be, in a few words."""

    created_ns: int
    seen_ns: int
    is_ended: bool = False

    def is_open(self, now_ns: int) -> bool:
        idle = now_ns - self.seen_ns >= IDLE_NS
        return not self.is_ended and not idle and now_ns - self.created_ns < LONGEST_NS


class Sessions(RuleBasedStateMachine):
    """Any order of logins, requests, ends and pauses: the server and the few words agree."""

    database: ServerDatabase
    user: User
    begun = Bundle("begun")

    @initialize()
    def start(self) -> None:
        self.clock = ManualClock()
        self.models: dict[str, _Model] = {}
        with self.database.begin() as connection:
            revoke_sessions(connection, self.user.user_id)

    @rule(target=begun)
    def log_in(self) -> str:
        now_ns = self.clock.wall_ns()
        with self.database.begin() as connection:
            secret = begin_session(connection, now_ns, self.user.user_id, HOME).secret
        self.models[secret] = _Model(now_ns, now_ns)
        return secret

    @rule(target=begun, before=begun)
    def log_in_again(self, before: str) -> str:
        now_ns = self.clock.wall_ns()
        with self.database.begin() as connection:
            new = begin_session(connection, now_ns, self.user.user_id, HOME, before=before)
        self.models[before].is_ended = True
        self.models[new.secret] = _Model(now_ns, now_ns)
        return new.secret

    @rule(secret=begun)
    def ask(self, secret: str) -> None:
        now_ns = self.clock.wall_ns()
        with self.database.begin() as connection:
            found = find_session(connection, now_ns, secret)
            if found is not None:
                touch_session(connection, now_ns, found.session.session_id)
        if self.models[secret].is_open(now_ns):
            self.models[secret].seen_ns = now_ns

    @rule(secret=begun)
    def log_out(self, secret: str) -> None:
        with self.database.begin() as connection:
            end_session(connection, secret)
        self.models[secret].is_ended = True

    @rule(seconds=st.sampled_from([1, 600, 1_799, 1_800, 6 * 3600]))
    def wait(self, seconds: int) -> None:
        self.clock.advance(seconds)

    @invariant()
    def agree(self) -> None:
        now_ns = self.clock.wall_ns()
        wanted = {secret for secret, model in self.models.items() if model.is_open(now_ns)}
        with self.database.reading() as connection:
            found = {one for one in self.models if find_session(connection, now_ns, one)}
            listed = list_sessions(connection, now_ns, self.user.user_id)
        assert found == wanted
        assert len(listed) == len(wanted)


@pytest.fixture(scope="module")
def shared() -> Iterator[tuple[ServerDatabase, User]]:
    with TemporaryDirectory() as folder:
        database = ServerDatabase(Path(folder) / "server.db", ManualClock())
        with database.begin() as connection:
            user = add_user(connection, 1, "anna", Role.VIEWER, "no hash")
        yield database, user
        database.close()


def test_any_order_of_events(shared: tuple[ServerDatabase, User]) -> None:
    Sessions.database, Sessions.user = shared
    run_state_machine_as_test(Sessions, settings=settings(max_examples=15, stateful_step_count=20))
