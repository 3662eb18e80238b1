"""Rows of commands: made once, claimed by the newest connection, answered once, expired."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest
from sqlalchemy import Connection, event

from amberbox.core.clock import NS
from amberbox.core.command import (
    AnswerState,
    Command,
    CommandAnswer,
    LeaseState,
    decode_command,
    key_id,
    new_command_id,
    sign_command,
)
from amberbox.core.ed25519 import new_private_key, public_key_of
from amberbox.core.errors import UsageError
from amberbox.link import limits
from amberbox.link.frames import Hello
from amberbox.link.ledger import StaleEpochError
from amberbox.server import commands
from amberbox.server.commands import LONGEST_NS, MOST_OPEN, RESEND_NS, StoredCommand
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest import ledger
from tests.support.command_rows import HOUR_NS, command

HELLO = Hello("r1", "s", "boot", {}, "", 0, 0, "1", capabilities=[limits.COMMANDS])
NOW_NS = 1_800_000_000 * NS
PRIVATE, CHALLENGE = new_private_key(), bytes(range(32))
KEY = key_id(public_key_of(PRIVATE))
T = TypeVar("T")


class Rows:
    """A database with one robot, each call in a transaction of its own."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.database = ServerDatabase(path)
        self.now_ns = NOW_NS

    def do(self, work: Callable[[Connection], T]) -> T:
        with self.database.begin() as connection:
            return work(connection)

    def connect(self, robot: str = "r1", store_id: str = "s") -> int:
        hello = msgspec.structs.replace(HELLO, robot=robot, store_id=store_id)
        epoch = self.do(lambda c: ledger.admit(c, hello, self.now_ns).epoch)
        self.do(lambda c: commands.begin_contact(c, robot, epoch, store_id))
        return epoch

    def create(self, one: Command, lifetime_ns: int = HOUR_NS, *challenges: bytes) -> StoredCommand:
        return self.do(lambda c: commands.create(c, self.now_ns, one, lifetime_ns, challenges))

    def claim(self, epoch: int, robot: str = "r1") -> list[str]:
        data = self.do(lambda c: commands.claim(c, robot, epoch, self.now_ns))
        return [decode_command(one).id for one in data]

    def answer(
        self, epoch: int, *answers: CommandAnswer, store_id: str = "s"
    ) -> commands.StoredAnswers:
        return self.do(
            lambda c: commands.store_answers(c, "r1", epoch, store_id, answers, self.now_ns)
        )

    def find(self, one: StoredCommand | Command) -> StoredCommand:
        found = self.do(lambda c: commands.find(c, self.now_ns, one.id))
        assert found is not None
        return found

    def signed(self, one: Command, challenge: bytes = CHALLENGE, ttl_s: int = 30) -> Command:
        server = self.do(lambda c: commands.server_id(c, self.now_ns))
        return sign_command(one, PRIVATE, lease=1, challenge=challenge, ttl_s=ttl_s, server=server)

    def reopen(self) -> None:
        self.database.close()
        self.database = ServerDatabase(self.path)


@pytest.fixture
def rows(tmp_path: Path) -> Iterator[Rows]:
    found = Rows(tmp_path / "server.db")
    yield found
    found.database.close()


def said(one: StoredCommand, state: AnswerState, number: int, reason: str = "") -> CommandAnswer:
    return CommandAnswer(one.id, state, reason, "{}", 5, "boot", 6, number)


def drive() -> Command:
    return command(action="drive_linear", parameters='{"distance_m": 1}', risk="moves")


def test_the_id_of_a_server_is_made_once(rows: Rows, tmp_path: Path) -> None:
    first = rows.do(lambda c: commands.server_id(c, 1))
    rows.reopen()
    assert rows.do(lambda c: commands.server_id(c, 2)) == first
    assert len(bytes.fromhex(first)) == 16
    other = Rows(tmp_path / "other.db")
    assert other.do(lambda c: commands.server_id(c, 1)) != first
    other.database.close()


def test_a_command_waits_for_a_robot_that_is_away(rows: Rows) -> None:
    one = command(run="run-1", step="step-2", parameters='{"a": [1.0, 1e3]}')
    stored = rows.create(one)
    assert (stored.state, stored.sends, stored.answers) == ("waiting", 0, [])
    assert (stored.issuer, stored.run, stored.step) == ("anna", "run-1", "step-2")
    assert (stored.created_ns, stored.expires_ns) == (NOW_NS, NOW_NS + HOUR_NS)
    epoch = rows.connect()
    [data] = rows.do(lambda c: commands.claim(c, "r1", epoch, NOW_NS))
    sent = decode_command(data)
    assert msgspec.structs.replace(sent, created_ns=0, expires_ns=0) == one
    assert (sent.created_ns, sent.expires_ns) == (NOW_NS, NOW_NS + HOUR_NS)
    assert (rows.find(one).state, rows.find(one).sent_ns) == ("sent", NOW_NS)


def test_a_command_is_made_once_and_another_with_its_id_is_refused(rows: Rows) -> None:
    one = command()
    first = rows.create(one)
    rows.now_ns += NS
    assert rows.create(one, 2 * HOUR_NS) == first
    for change in ({"parameters": '{"a": 1}'}, {"issuer": "otto"}, {"robot": "r2"}, {"run": "x"}):
        with pytest.raises(UsageError, match="another command has the id"):
            rows.create(msgspec.structs.replace(one, **change))
    assert rows.do(lambda c: len(commands.listed(c, NOW_NS))) == 1


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"id": "short"}, "no command"),
        ({"parameters": "[]"}, "no JSON object"),
        ({"parameters": '{"a": NaN}'}, "not finite"),
        ({"parameters": '{"a": 1, "a": 2}'}, "given twice"),
        ({"issuer": "two\nlines"}, "no command"),
        ({"robot": "../x"}, "no command"),
        ({"risk": "moves"}, "has to be signed"),
        ({"risk": "state"}, "has to be signed"),
    ],
)
def test_what_no_robot_would_accept_is_not_stored(
    rows: Rows, values: dict[str, Any], what: str
) -> None:
    with pytest.raises(UsageError, match=what):
        rows.create(command(**values))
    assert rows.do(lambda c: commands.listed(c, NOW_NS)) == []


@pytest.mark.parametrize("lifetime_ns", [0, -1, LONGEST_NS + 1])
def test_a_command_does_not_wait_for_ever(rows: Rows, lifetime_ns: int) -> None:
    with pytest.raises(UsageError, match="at most 90"):
        rows.create(command(), lifetime_ns)


def test_commands_that_wait_are_bounded_per_robot(rows: Rows) -> None:
    for _ in range(MOST_OPEN):
        rows.create(command())
    with pytest.raises(UsageError, match="wait for an answer"):
        rows.create(command())
    assert rows.create(command("r2")).state == "waiting"
    rows.now_ns += HOUR_NS
    assert rows.create(command()).state == "waiting", "what expired does not count"


def test_a_signed_command_needs_a_challenge_of_the_present_connection(rows: Rows) -> None:
    one = rows.signed(drive())
    with pytest.raises(UsageError, match="not connected, or has not minted"):
        rows.create(one)
    with pytest.raises(UsageError, match="not connected, or has not minted"):
        rows.create(one, HOUR_NS, bytes(32))
    stored = rows.create(one, HOUR_NS, bytes(32), CHALLENGE)
    assert (stored.key_id, stored.risk) == (KEY, "moves")
    assert stored.expires_ns == NOW_NS + 30 * NS, "it lives as long as it was signed for"
    assert rows.create(one) == stored, "asked again it is there already"
    epoch = rows.connect()
    assert rows.do(lambda c: commands.claim(c, "r1", epoch, NOW_NS))[0]
    with pytest.raises(UsageError, match="another command has the id"):
        changed = msgspec.structs.replace(one, parameters='{"distance_m": 2}')
        rows.create(changed, HOUR_NS, CHALLENGE)


def test_a_command_signed_for_another_server_or_with_a_revoked_key_is_not_stored(
    rows: Rows,
) -> None:
    elsewhere = sign_command(
        drive(), PRIVATE, lease=1, challenge=CHALLENGE, ttl_s=30, server="ab" * 16
    )
    with pytest.raises(UsageError, match="for another server"):
        rows.create(elsewhere, HOUR_NS, CHALLENGE)
    assert rows.do(lambda c: commands.revoke(c, NOW_NS, KEY, "otto", "lost"))
    with pytest.raises(UsageError, match="is revoked"):
        rows.create(rows.signed(drive()), HOUR_NS, CHALLENGE)


@pytest.mark.parametrize("ttl_s", [0, 61, 31_536_000])
def test_a_signature_that_holds_too_long_is_not_stored(rows: Rows, ttl_s: int) -> None:
    with pytest.raises(UsageError, match="1 to 60 s"):
        rows.create(rows.signed(drive(), ttl_s=ttl_s), HOUR_NS, CHALLENGE)


def test_unanswered_commands_are_sent_on_each_connection_and_again_after_a_while(
    rows: Rows,
) -> None:
    first, second = rows.create(command()), rows.create(command())
    epoch = rows.connect()
    assert rows.claim(epoch) == [first.id, second.id]
    assert rows.claim(epoch) == []
    rows.now_ns += RESEND_NS
    assert rows.claim(epoch) == [first.id, second.id]
    rows.answer(epoch, said(first, "done", 1))
    epoch = rows.connect()
    assert rows.claim(epoch) == [second.id]
    assert rows.find(second).sends == 3


def test_a_clock_that_was_set_back_does_not_keep_commands_from_being_sent(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.now_ns += HOUR_NS // 2
    assert rows.claim(epoch) == [one.id]
    rows.now_ns = NOW_NS
    assert rows.claim(epoch) == [one.id]


def test_an_accepted_command_is_sent_once_on_each_connection(rows: Rows) -> None:
    """So that the robot repeats what a server that was restored does not know any more."""
    one = rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)
    rows.answer(epoch, said(one, "accepted", 1))
    rows.now_ns += RESEND_NS
    assert rows.claim(epoch) == []
    epoch = rows.connect()
    assert rows.claim(epoch) == [one.id] and rows.find(one).state == "accepted"
    assert rows.claim(epoch) == []
    rows.answer(epoch, said(one, "done", 2))
    assert rows.claim(rows.connect()) == []


def test_nothing_late_is_sent(rows: Rows) -> None:
    asked, done = rows.create(command()), rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)
    rows.answer(epoch, said(done, "accepted", 1))
    never, fresh = rows.create(command()), rows.create(command(), 2 * HOUR_NS)
    rows.now_ns += HOUR_NS
    found = rows.find(never), rows.find(asked), rows.find(done)
    assert [one.state for one in found] == ["expired", "expired", "accepted"]
    assert "before the robot was there" in found[0].reason
    assert "the robot may have received it" in found[1].reason
    assert rows.claim(rows.connect()) == [fresh.id]
    rows.now_ns -= HOUR_NS
    assert rows.find(never).state == "expired", "what was given up stays so"
    assert set(rows.claim(rows.connect())) == {done.id, fresh.id}


def test_the_robot_knows_better_than_the_clock(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)
    rows.now_ns += 2 * HOUR_NS
    epoch = rows.connect()
    assert rows.claim(epoch) == [] and rows.find(one).state == "expired"
    rows.answer(epoch, said(one, "accepted", 1), said(one, "done", 2))
    found = rows.find(one)
    assert (found.state, found.answered_ns, found.reason) == ("done", rows.now_ns, "")


def test_the_first_final_answer_counts_and_all_are_kept_once(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)
    answers = [said(one, "accepted", 1), said(one, "failed", 2, "no way")]
    assert rows.answer(epoch, *answers) == commands.StoredAnswers(2, (one.id,))
    for _ in range(2):
        assert rows.answer(epoch, *answers) == commands.StoredAnswers(2)
    rows.answer(epoch, said(one, "refused", 3, "other bytes"), said(one, "accepted", 4))
    found = rows.find(one)
    assert (found.state, found.reason) == ("failed", "no way")
    assert [(a.number, a.state) for a in found.answers] == [
        (1, "accepted"), (2, "failed"), (3, "refused"), (4, "accepted"),
    ]  # fmt: skip


def test_a_refusal_that_the_robot_could_not_store_is_kept_but_not_acknowledged(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)
    assert rows.answer(epoch, said(one, "refused", 0, "its disk is full")).number == 0
    assert rows.find(one).state == "refused"
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).answered == 0


def test_a_refusal_of_other_bytes_does_not_end_what_is_carried_out(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.answer(epoch, said(one, "accepted", 1), said(one, "refused", 0, "other content"))
    assert rows.find(one).state == "accepted"
    rows.answer(epoch, said(one, "done", 2))
    assert rows.find(one).state == "done"


def test_only_the_newer_of_two_connections_sends_and_stores(rows: Rows) -> None:
    one = rows.create(command())
    old, new = rows.connect(), rows.connect()
    works: list[Callable[[Connection], object]] = [
        lambda c: commands.claim(c, "r1", old, NOW_NS),
        lambda c: commands.store_answers(c, "r1", old, "s", [said(one, "done", 1)], NOW_NS),
        lambda c: commands.begin_contact(c, "r1", old, "s"),
        lambda c: commands.announce(c, "r1", old, "[]", NOW_NS),
        lambda c: commands.record_lease(c, "r1", old, LeaseState(1, "h", "r"), NOW_NS),
    ]
    for work in works:
        with pytest.raises(StaleEpochError):
            rows.do(work)
    assert rows.find(one) == one
    assert rows.claim(new) == [one.id]
    with pytest.raises(StaleEpochError):
        rows.do(lambda c: commands.claim(c, "nobody", 1, NOW_NS))


def test_a_robot_speaks_for_its_own_commands_only(rows: Rows) -> None:
    other = rows.create(command("r2"))
    epoch = rows.connect("r1")
    stored = rows.answer(epoch, said(other, "done", 1))
    assert (stored.changed, stored.unknown) == ((), (other.id,))
    assert rows.find(other) == other and rows.find(other).answers == []
    assert rows.claim(epoch) == []


def test_a_crash_between_sending_and_the_answer_sends_it_again(rows: Rows) -> None:
    one = rows.create(command())
    rows.claim(rows.connect())
    rows.reopen()
    assert rows.find(one).state == "sent"
    assert rows.claim(rows.connect()) == [one.id]


def test_a_crash_before_answers_are_stored_leaves_nothing_of_them(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.claim(epoch)

    def power_cut(*_: object) -> None:
        raise KeyboardInterrupt

    event.listen(rows.database.engine, "commit", power_cut)
    with pytest.raises(KeyboardInterrupt):
        rows.answer(epoch, said(one, "done", 1))
    event.remove(rows.database.engine, "commit", power_cut)
    rows.reopen()
    assert rows.find(one).answers == [] and rows.find(one).state == "sent"
    epoch = rows.connect()
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).answered == 0
    rows.answer(epoch, said(one, "done", 1))
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).answered == 1


def test_a_restored_database_learns_again_what_it_forgot(rows: Rows, tmp_path: Path) -> None:
    """The robot has done both and forgotten the answers, since the lost database had them."""
    early, late = rows.create(command()), command()
    rows.claim(rows.connect())
    rows.database.close()
    shutil.copy(rows.path, tmp_path / "backup.db")
    rows.reopen()
    rows.create(late)
    epoch = rows.connect()
    rows.claim(epoch)
    rows.answer(epoch, said(early, "done", 1), said(rows.find(late), "done", 2))
    rows.database.close()
    for file in tmp_path.glob("server.db*"):
        file.unlink()
    shutil.copy(tmp_path / "backup.db", rows.path)
    rows.reopen()
    assert rows.find(early).state == "sent"
    epoch = rows.connect()
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).answered == 0
    assert rows.claim(epoch) == [early.id], "sent again: the robot repeats its answer"
    stray = CommandAnswer(late.id, "done", number=3)
    stored = rows.answer(epoch, said(early, "done", 1), stray)
    assert (stored.number, stored.changed, stored.unknown) == (3, (early.id,), (late.id,))
    assert rows.answer(epoch, stray).unknown == ()
    assert rows.find(early).state == "done"


def test_another_store_counts_its_answers_anew(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    rows.answer(epoch, said(one, "accepted", 500))
    epoch = rows.connect(store_id="another")
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "another")).answered == 0
    rows.answer(epoch, said(one, "outcome_unknown", 1), store_id="another")
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "another")).answered == 1
    assert rows.find(one).state == "outcome_unknown"


def test_of_commands_that_are_not_known_here_so_many_are_kept(
    rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "MOST_UNKNOWN", 3)
    epoch, known = rows.connect(), rows.create(command())
    stray = [dataclasses.replace(known, id=f"{n:032x}") for n in range(5)]
    found = rows.answer(epoch, *(said(one, "done", n + 1) for n, one in enumerate(stray[:2])))
    assert found.unknown == (stray[0].id, stray[1].id)
    found = rows.answer(epoch, *(said(one, "done", n + 3) for n, one in enumerate(stray[2:])))
    assert (found.unknown, found.number) == ((stray[2].id,), 5), "it need not send them again"
    assert rows.answer(epoch, said(stray[0], "failed", 6)).unknown == ()
    rows.answer(epoch, said(known, "done", 7))
    assert rows.find(known).state == "done"


def test_a_robot_that_answers_without_end_fills_nothing(rows: Rows) -> None:
    one = rows.create(command())
    epoch = rows.connect()
    for number in range(1, 200, 10):
        many = [said(one, "accepted", number + n) for n in range(10)]
        assert rows.answer(epoch, *many).number == number + 9, "it need not send them again"
    assert len(rows.find(one).answers) == commands.MOST_ANSWERS
    rows.answer(epoch, said(one, "done", 300))
    assert rows.find(one).state == "done"


def test_an_older_log_of_the_same_store_is_acknowledged_by_its_own_numbers(rows: Rows) -> None:
    """An old image of the card: what it answers now has numbers that were given before."""
    one, two = rows.create(command()), rows.create(command())
    epoch = rows.connect()
    rows.answer(epoch, said(one, "accepted", 300), said(one, "done", 301))
    epoch = rows.connect()
    assert rows.answer(epoch, said(two, "done", 300)).number == 300
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).answered == 300
    assert rows.find(two).state == "done"
    begun = rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s", is_other_history=True))
    assert begun.answered == 0, "where the image is noticed, nothing is taken for stored"


def test_revocations_only_grow(rows: Rows) -> None:
    assert rows.do(lambda c: commands.revoke(c, 5, KEY, "anna", "lost"))
    assert not rows.do(lambda c: commands.revoke(c, 6, KEY, "otto", "again"))
    [one] = rows.do(commands.revoked_keys)
    assert one == commands.RevokedKey(KEY, "anna", "lost", 5)
    for wrong in ("", "abc", KEY.upper() + "X", KEY + "\n"):
        with pytest.raises(UsageError, match="no id of a key"):
            rows.do(lambda c, wrong=wrong: commands.revoke(c, 7, wrong, "anna", ""))  # type: ignore[misc]  # wrong
    epoch = rows.connect()
    assert rows.do(lambda c: commands.begin_contact(c, "r1", epoch, "s")).revoked == [KEY]


def test_actions_and_lease_are_what_the_robot_said_last(rows: Rows) -> None:
    assert rows.do(lambda c: commands.commanded(c, "r1")) is None
    epoch = rows.connect()
    rows.do(lambda c: commands.announce(c, "r1", epoch, '["dock"]', 5))
    rows.do(lambda c: commands.record_lease(c, "r1", epoch, LeaseState(3, "h", "r"), 6))
    rows.reopen()
    said_last = commands.CommandedRobot("r1", '["dock"]', 5, LeaseState(3, "h", "r"), 6)
    assert rows.do(lambda c: commands.commanded(c, "r1")) == said_last
    rows.connect()
    assert rows.do(lambda c: commands.commanded(c, "r1")) == said_last


def test_commands_are_listed_newest_first(rows: Rows) -> None:
    made = [rows.create(command("r1" if n % 2 else "r2")) for n in range(6)]
    every = rows.do(lambda c: commands.listed(c, NOW_NS))
    assert [one.id for one in every] == [one.id for one in reversed(made)]
    mine = rows.do(lambda c: commands.listed(c, NOW_NS, "r1", limit=2))
    assert [one.id for one in mine] == [made[5].id, made[3].id]
    rest = rows.do(lambda c: commands.listed(c, NOW_NS, "r1", mine[-1].number))
    assert [one.id for one in rest] == [made[1].id]
    assert rows.do(lambda c: commands.find(c, NOW_NS, new_command_id())) is None
