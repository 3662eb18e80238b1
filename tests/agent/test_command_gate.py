"""The gate: each reason of a refusal, lease, confirmation on site, abort, revocation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from random import Random

import msgspec
import pytest

from amberbox.agent.command_gate import CommandGate, Decision
from amberbox.agent.command_log import CommandLogFile
from amberbox.agent.command_trust import CommandTrust
from amberbox.core.command import Command, encode_command
from amberbox.core.errors import AmberboxError
from amberbox.testing.clock import ManualClock
from tests.support.commands import (
    ANNA,
    BEN,
    EVE,
    ROBOT,
    FakeActions,
    Person,
    order,
    signed,
    trust,
)
from tests.support.simulated_disk import SimulatedDisk

PATH = Path("/store/commands.log")


class Robot:
    """A gate on a disk in memory, with a lease of anna's run and a fresh challenge."""

    def __init__(self, confirm: str = "code") -> None:
        self.clock, self.disk = ManualClock(), SimulatedDisk(Random(0))
        self.trust: CommandTrust | AmberboxError | None = trust(confirm)
        self.random = Random(1)
        self.start()

    def start(self) -> list[Decision]:
        self.log = CommandLogFile(PATH, self.disk)
        self.gate = CommandGate(
            ROBOT, self.log, self.clock, self.read_trust, FakeActions(), self.random.randbytes
        )
        found = self.gate.boot()
        self.challenge = self.gate.mint()
        self.lease = self.gate.take_lease("anna", "run 1").number
        self.gate.step()
        return found

    def read_trust(self) -> CommandTrust | None:
        if isinstance(self.trust, AmberboxError):
            raise self.trust
        return self.trust

    def command(
        self, number: int = 1, action: str = "lamp", person: Person = ANNA, **changes: object
    ) -> Command:
        options = {"lease": self.lease, "ttl_s": 30, "server": "9f3c", **changes}
        risk = FakeActions().risks[action]
        made = msgspec.structs.replace(
            order(number, action, risk), run=str(options.pop("run", "run 1"))
        )
        return signed(made, person, self.challenge, **options)  # type: ignore[arg-type]  # by name

    def give(self, command: Command) -> list[Decision]:
        return self.gate.receive(encode_command(command))


def kinds(decisions: list[Decision]) -> list[str]:
    return [d.answer.state if d.answer else d.kind for d in decisions if d.kind != "note"]


def reason(decisions: list[Decision]) -> str:
    (answer,) = [d.answer for d in decisions if d.answer is not None]
    assert answer.state == "refused"
    return answer.reason


def test_a_record_command_runs_without_signature_and_trust_file() -> None:
    robot = Robot()
    robot.trust = None
    assert kinds(robot.give(order(1))) == ["accepted", "run"]
    found = robot.gate.ended(order(1).id, "done", result='{"file": "a"}')
    assert kinds(found) == ["done"]
    assert [(a.number, a.result) for a in robot.gate.unanswered()] == [(2, '{"file": "a"}')]
    robot.gate.acknowledged(2)
    assert robot.gate.unanswered() == []
    assert kinds(robot.give(order(1))) == ["done"]  # again: the known answer, not the action


def test_accepted_is_on_the_disk_before_it_runs() -> None:
    robot = Robot()
    robot.give(robot.command())
    robot.disk.cut_power()
    assert kinds(robot.start()) == ["outcome_unknown"]
    assert kinds(robot.give(robot.command())) == ["refused"]


REFUSALS: dict[str, Callable[[Robot], Command]] = {
    "no action": lambda r: msgspec.structs.replace(r.command(), action="fly"),
    "no parameter bad": lambda r: msgspec.structs.replace(r.command(), parameters='{"bad": 1}'),
    "has the risk moves": lambda r: order(1, "drive", "state"),
    "not signed": lambda r: order(1, "lamp", "state"),
    "another server": lambda r: r.command(server="other"),
    "not in the trust file": lambda r: r.command(person=EVE),
    "ben may not order drive": lambda r: r.command(action="drive", person=BEN),
    "signature is not that of anna": lambda r: msgspec.structs.replace(r.command(), step="x"),
    "time to live is 31536000 s": lambda r: r.command(ttl_s=31_536_000),
    "held by anna": lambda r: r.command(lease=r.lease + 1),
    r"held by anna \(run run 1\)": lambda r: r.command(run="run 2"),
    "for the robot other": lambda r: msgspec.structs.replace(r.command(), robot="other"),
}


@pytest.mark.parametrize("why", REFUSALS)
def test_each_refusal_has_its_reason(why: str) -> None:
    robot = Robot()
    found = robot.give(REFUSALS[why](robot))
    with pytest.raises(AssertionError, match=why):
        raise AssertionError(reason(found))
    assert kinds(robot.give(robot.command(2))) == ["accepted", "run"]


def test_what_is_no_command_is_only_recorded() -> None:
    (found,) = Robot().gate.receive(b"\xc0")
    assert found.kind == "note" and "no command" in found.text


def test_what_cannot_be_read_is_answered_by_its_id_and_not_stored() -> None:
    robot = Robot()
    later = {"id": f"{7:032x}", "robot": ROBOT, "action": "lamp", "risk": "of a later version"}
    for _ in range(2):
        (found,) = robot.gate.receive(msgspec.msgpack.encode(later))
        assert found.answer is not None
        assert (found.answer.id, found.answer.number) == (later["id"], 0)
        assert found.answer.state == "refused"
        assert "cannot be read" in found.answer.reason
    assert robot.gate.unanswered() == []
    robot.give(robot.command(8))
    (found,) = robot.gate.receive(msgspec.msgpack.encode({**later, "id": f"{8:032x}"}))
    assert found.answer is not None and found.answer.number == 0
    assert "other content" in found.answer.reason
    bad: list[object] = ["../../etc", "F" * 32, 7, {}, ["0" * 32]]
    for hostile in bad:
        (found,) = robot.gate.receive(msgspec.msgpack.encode({**later, "id": hostile}))
        assert (found.kind, found.id) == ("note", "")
    nested = b"\x82\xa2id\xd9\x20" + b"0" * 32 + b"\xa1x" + b"\x91" * 60_000
    (found,) = robot.gate.receive(nested)
    assert found.kind == "note" and len(found.text) <= 1000


def test_the_same_id_with_other_content_is_refused() -> None:
    robot = Robot()
    robot.give(robot.command())
    assert "other content" in reason(robot.give(order(1)))
    assert [a.state for a in robot.gate.unanswered()] == ["accepted"]


def test_no_trust_file_or_a_bad_one_refuses_what_is_signed() -> None:
    robot = Robot()
    robot.trust = None
    assert "no 'commands:'" in reason(robot.give(robot.command(1)))
    robot.trust = AmberboxError("others may write to it")
    assert "others may write" in reason(robot.give(robot.command(2)))


def test_freshness_counts_boot_time_and_not_the_wall_clock() -> None:
    robot = Robot()
    robot.clock.step(-86_400)
    for _ in range(10):
        robot.clock.advance(3.0)
        assert not robot.gate.renew(robot.lease).reason
    assert kinds(robot.give(robot.command(1))) == ["accepted", "run"]
    robot.clock.boot += 1
    robot.clock.step(-86_400)
    assert "later than 30 s" in reason(robot.give(robot.command(2)))


def test_a_challenge_does_not_outlive_the_process() -> None:
    robot = Robot()
    old = robot.command()
    robot.disk.kill()
    robot.start()
    assert "since it started" in reason(robot.give(old))


def test_a_lease_is_lost_after_3_s_and_its_number_only_grows() -> None:
    robot = Robot()
    robot.give(robot.command())
    robot.clock.advance(3.0)
    assert not robot.gate.renew(robot.lease).reason
    robot.clock.boot += 3_000_000_001
    assert "lost" in robot.gate.renew(robot.lease).reason
    (stop,) = [d for d in robot.gate.step() if d.kind == "stop"]
    assert stop.id == order(1).id
    refused = robot.gate.take_lease("ben", "run 2")
    assert "still being stopped" in refused.reason and not refused.holder
    robot.gate.ended(order(1).id, "aborted")
    given = robot.gate.take_lease("ben", "run 2")
    assert (given.number, given.holder, given.reason) == (robot.lease + 1, "ben", "")
    robot.disk.cut_power()
    before = given.number
    robot.start()
    assert robot.lease == before + 1


def test_a_second_run_is_refused_with_the_name_of_the_holder() -> None:
    robot = Robot()
    refused = robot.gate.take_lease("second server", "run 9")
    assert "anna" in refused.reason and refused.number == robot.lease
    assert not robot.gate.take_lease("anna", "run 1").reason  # asked again: it has it
    robot.gate.release(robot.lease)
    assert not robot.gate.take_lease("second server", "run 9").reason


@pytest.mark.parametrize("confirm", ["code", "button"])
def test_a_motion_is_confirmed_on_site(confirm: str) -> None:
    robot = Robot(confirm)
    (ask,) = robot.give(robot.command(action="drive"))
    assert (ask.kind, len(ask.code), ask.person) == ("ask", 6 * (confirm == "code"), "anna")
    assert kinds(robot.give(robot.command(action="drive"))) == []
    if confirm == "code":
        assert kinds(robot.gate.confirmed("wrong")) == []
        assert kinds(robot.gate.confirmed(ask.code)) == ["accepted", "run"]
    else:
        assert kinds(robot.gate.confirmed("")) == []
        assert kinds(robot.gate.confirmed(on_site=True)) == ["accepted", "run"]
    assert kinds(robot.gate.confirmed(ask.code, on_site=True)) == []


def test_a_code_may_be_tried_three_times() -> None:
    robot = Robot()
    (ask,) = robot.give(robot.command(action="drive"))
    robot.gate.confirmed("000000")
    robot.gate.confirmed("000001")
    assert "3 times" in reason(robot.gate.confirmed("000002"))
    assert kinds(robot.gate.confirmed(ask.code)) == []


def test_a_code_counts_only_for_its_command() -> None:
    robot = Robot()
    (ask,) = robot.give(robot.command(1, action="drive"))
    waiting = robot.gate.waiting()
    assert waiting is not None and (waiting.id, waiting.by_code) == (ask.id, True)
    for _ in range(5):
        assert kinds(robot.gate.confirmed(ask.code, order(2).id)) == []
    assert robot.gate.waiting() == waiting, "these were no tries"
    robot.gate.confirmed("000000", ask.id)
    tried = robot.gate.waiting()
    assert tried is not None and tried.tries == 1
    assert kinds(robot.gate.confirmed(ask.code, ask.id)) == ["accepted", "run"]
    assert robot.gate.waiting() is None


def test_a_late_confirmation_counts_for_nothing() -> None:
    robot = Robot()
    robot.give(robot.command(action="drive"))
    for _ in range(10):
        robot.clock.advance(3.0)
        robot.gate.renew(robot.lease)
    robot.clock.boot += 1
    assert "within 30 s" in reason(robot.gate.confirmed(on_site=True))


def test_what_is_taken_away_while_a_motion_waits_counts() -> None:
    robot = Robot()
    robot.give(robot.command(action="drive"))
    robot.trust = CommandTrust("9f3c", {"ben": BEN.trusted("moves")})
    assert "not in the trust file" in reason(robot.gate.confirmed(on_site=True))


@pytest.mark.parametrize("target", ["", "run 1", f"{1:032x}"])
def test_an_abort_stops_and_may_be_repeated(target: str) -> None:
    robot = Robot()
    robot.give(robot.command())
    for _ in range(2):
        assert kinds(robot.gate.abort(target)) == ["stop"]
    robot.gate.ended(order(1).id, "aborted")
    assert kinds(robot.gate.abort(target)) == []


def test_an_abort_may_come_before_its_command_and_outlives_a_power_cut() -> None:
    robot = Robot()
    assert kinds(robot.gate.abort(order(1).id)) == ["aborted"]
    robot.disk.cut_power()
    robot.start()
    assert kinds(robot.give(order(1))) == ["aborted"]


def test_an_abort_counts_on_a_full_disk() -> None:
    robot = Robot()
    robot.give(robot.command())
    robot.disk.fill()
    assert "stop" in kinds(robot.gate.abort())


def test_a_revoked_key_ends_its_lease_and_run_for_good() -> None:
    robot = Robot()
    robot.give(robot.command())
    assert kinds(robot.gate.revoke([ANNA.key_id, "junk"])) == ["stop"]
    assert not robot.gate.lease().holder
    robot.gate.ended(order(1).id, "aborted")
    robot.disk.cut_power()
    robot.start()
    assert "revoked" in reason(robot.give(robot.command(2)))
    assert kinds(robot.gate.revoke([ANNA.key_id])) == []


def test_a_server_that_revokes_without_end_gets_nothing_signed_any_more() -> None:
    robot = Robot()
    robot.gate.revoke(f"{n:016x}" for n in range(20_000))
    assert len(robot.log.revoked) == 10_000
    assert "revoked" in reason(robot.give(robot.command()))


def test_nothing_runs_while_the_log_cannot_be_written_and_ends_are_stored_later() -> None:
    robot = Robot()
    robot.give(order(1))
    robot.disk.fill()
    assert "No space left" in reason(robot.give(order(2)))
    assert kinds(robot.gate.ended(order(1).id, "done")) == []
    assert "No space" in robot.gate.take_lease("ben", "").reason or robot.gate.lease().holder
    robot.disk.failures = {}
    assert kinds(robot.gate.step()) == ["done", "refused"]
    assert kinds(robot.give(order(2))) == ["refused"]  # it was refused, and that stays
    assert kinds(robot.give(order(3))) == ["accepted", "run"]
