"""The command log keeps what it said that it keeps, wherever process, power or disk fail."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from random import Random

import pytest

from amberbox.agent.command_log import CommandLogError, CommandLogFile
from amberbox.core.command import AnswerState, CommandAnswer
from tests.support.simulated_disk import KilledError, SimulatedDisk

PATH = Path("/store/commands.log")
DIGEST = "0" * 64


def answer(n: int, state: AnswerState = "accepted", result: str = "") -> CommandAnswer:
    return CommandAnswer(f"{n:032x}", state, f"reason {n}", result, n, "boot", n)


def states(log: CommandLogFile, most: int = 100) -> dict[int, str]:
    found = {n: log.seen(f"{n:032x}") for n in range(most)}
    return {n: seen[1].state for n, seen in found.items() if seen is not None}


def test_what_was_added_is_there_when_it_is_opened_again(tmp_path: Path) -> None:
    log = CommandLogFile(tmp_path / "log")
    assert [log.add(answer(n), DIGEST).number for n in (1, 2, 3)] == [1, 2, 3]
    log.add(answer(1, "done", '{"a": 1}'), DIGEST)
    log.add_lease(7)
    log.add_revoked(["b", "a"])
    log.acknowledge(2)
    log.close()
    again = CommandLogFile(tmp_path / "log")
    assert states(again) == {1: "done", 2: "accepted", 3: "accepted"}
    assert [a.id[-1] for _, a in again.running()] == ["2", "3"]
    assert [(a.number, a.state, a.result) for a in again.unanswered()] == [
        (3, "accepted", ""), (4, "done", '{"a": 1}')
    ]  # fmt: skip
    assert (again.lease_number, set(again.revoked), again.notes) == (7, {"a", "b"}, [])
    assert again.add(answer(4), DIGEST).number == 5
    again.close()


def test_a_result_stays_until_the_server_has_it() -> None:
    log = CommandLogFile(PATH, SimulatedDisk(Random(0)))
    log.add(answer(1), DIGEST)
    log.add(answer(1, "done", "{}"), DIGEST)
    seen = log.seen(answer(1).id)
    assert seen is not None and seen[1].result == "{}"
    log.acknowledge(2)
    seen = log.seen(answer(1).id)
    assert seen is not None and (seen[1].result, seen[1].state) == ("", "done")
    assert log.unanswered() == []


def test_an_acknowledgement_of_what_was_never_sent_loses_no_answer() -> None:
    log = CommandLogFile(PATH, SimulatedDisk(Random(0)))
    first = log.add(answer(1), DIGEST)
    log.acknowledge(10**9)
    assert log.unanswered() == [first]
    log.add(answer(1, "done"), DIGEST)
    assert [a.state for a in log.unanswered()] == ["done"]


@pytest.mark.parametrize("cut", range(1, 60))
def test_a_torn_tail_is_cut_off_and_said(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "log"
    log = CommandLogFile(path)
    log.add(answer(1), DIGEST)
    log.add(answer(2), DIGEST)
    log.close()
    os.truncate(path, path.stat().st_size - cut)
    again = CommandLogFile(path)
    assert states(again) == {1: "accepted"}
    assert "torn" in again.notes[0]
    assert again.add(answer(2), DIGEST).number == 2
    again.close()
    assert CommandLogFile(path).notes == []


def test_a_damaged_line_costs_only_itself_and_no_number_comes_twice(tmp_path: Path) -> None:
    path = tmp_path / "log"
    log = CommandLogFile(path)
    for n in range(1, 4):
        log.add(answer(n), DIGEST)
    log.add_lease(5)
    log.add_lease(6)
    log.add(answer(9), DIGEST)
    log.close()
    lines = path.read_bytes().splitlines(keepends=True)
    lines[2] = lines[2].replace(b"accepted", b"bccepted")
    lines[5] = b"\x00" * (len(lines[5]) - 1) + b"\n"
    path.write_bytes(b"".join(lines))
    again = CommandLogFile(path)
    assert states(again) == {1: "accepted", 3: "accepted", 9: "accepted"}
    assert "damaged" in again.notes[0]
    number = again.lease_number
    assert number > 6
    again.close()
    third = CommandLogFile(path)  # what was raised stays raised
    assert third.lease_number >= number and third.notes == []
    assert third.add(answer(50), DIGEST).number > 1000


def script(log: CommandLogFile, done: list[int], leases: list[int]) -> None:
    """Do one of everything many times; ``done`` are the ids whose answers count."""
    for n in range(1, 12):
        log.add(answer(n), DIGEST)
        done.append(n)
        if n % 3 == 0:
            log.add_lease(n)
            leases.append(n)
        log.add(answer(n, "done", "x" * 50), DIGEST)
        log.acknowledge(2 * n - 3)
        log.tidy()


def calls_of_script() -> int:
    disk = SimulatedDisk(Random(1))
    script(CommandLogFile(PATH, disk, tidy_bytes=600), [], [])
    assert disk.calls > 100
    return disk.calls


@pytest.mark.parametrize("power", [False, True], ids=["killed", "power cut"])
def test_nothing_that_counted_is_lost_at_any_system_call(power: bool) -> None:
    for die_in in range(1, calls_of_script() + 1):
        for seed in range(5 if power else 2):
            disk = SimulatedDisk(Random(seed), die_in=die_in)
            done: list[int] = []
            leases = [0]
            with pytest.raises(KilledError):
                script(CommandLogFile(PATH, disk, tidy_bytes=600), done, leases)
                raise KilledError  # fewer calls than counted: parts of writes are random
            disk.cut_power() if power else disk.kill()
            again = CommandLogFile(PATH, disk, tidy_bytes=600)
            found = states(again)
            assert set(done) <= set(found) <= {*done, len(done) + 1}, (die_in, seed)
            assert all(found[n] == "done" for n in done[:-1]), (die_in, seed)
            assert leases[-1] <= again.lease_number <= leases[-1] + 3
            assert again.notes == [] or "torn" in again.notes[0]
            assert again.add(answer(90), DIGEST).number >= 2 * len(done)


def test_the_file_stays_small_and_the_newest_ids_are_remembered() -> None:
    disk = SimulatedDisk(Random(2))
    log = CommandLogFile(PATH, disk, most_ids=10, tidy_bytes=2000)
    log.add(answer(0), DIGEST)  # this one runs all the time
    for n in range(1, 200):
        log.add(answer(n), DIGEST)
        log.add(answer(n, "done"), DIGEST)
        log.acknowledge(2 * n + 1)
        log.tidy()
        assert len(disk.names[str(PATH)].content) < 12_000
    remembered = {0, *range(191, 200)}
    assert set(states(log, 300)) == remembered
    assert set(states(CommandLogFile(PATH, disk, most_ids=10), 300)) == remembered


@pytest.mark.parametrize("call", ["write", "fsync", "ftruncate", "replace"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_what_cannot_be_written_does_not_count_and_goes_on_later(call: str, code: int) -> None:
    disk = SimulatedDisk(Random(3))
    log = CommandLogFile(PATH, disk)
    log.add(answer(1), DIGEST)
    disk.failures = (
        {call: code, "write": code} if call in ("ftruncate", "replace") else {call: code}
    )
    for _ in range(3):
        with pytest.raises(CommandLogError, match=os.strerror(code)):
            log.add(answer(2), DIGEST)
        with pytest.raises(CommandLogError):
            log.add_lease(1)
    assert states(log) == {1: "accepted"} and log.lease_number == 0
    disk.failures = {}
    assert log.add(answer(3), DIGEST).number == 2
    for _ in range(3):
        disk.cut_power()
        again = CommandLogFile(PATH, disk)
        assert states(again) == {1: "accepted", 3: "accepted"} and again.notes == []


def test_a_full_disk_keeps_the_old_file_instead_of_a_smaller_one() -> None:
    disk = SimulatedDisk(Random(4))
    log = CommandLogFile(PATH, disk, most_ids=5, tidy_bytes=500)
    for n in range(1, 9):
        log.add(answer(n, "done"), DIGEST)
    disk.fill()
    log.tidy()
    disk.failures = {}
    log.add(answer(20, "done"), DIGEST)
    disk.cut_power()
    again = CommandLogFile(PATH, disk, most_ids=5)
    assert 20 in states(again) and len(states(again)) == 5


@pytest.mark.parametrize("call", ["open", "fsync"])
def test_a_log_that_cannot_be_opened_is_an_error_with_a_hint(call: str) -> None:
    disk = SimulatedDisk(Random(5), failures={call: errno.EIO})
    with pytest.raises(CommandLogError, match=r"commands\.log") as error:
        CommandLogFile(PATH, disk)
    assert error.value.hint


def test_orders_of_the_robot_itself_are_counted_and_kept_from_servers() -> None:
    disk = SimulatedDisk(Random(0))
    log = CommandLogFile(PATH, disk, most_ids=5, tidy_bytes=0)
    log.add(answer(1), DIGEST, "policy a")
    log.add(answer(2, "refused"), DIGEST, "policy a")
    log.add(answer(3), DIGEST, "policy a")
    log.add(answer(1, "done"), DIGEST)  # as after a restart, which knows no origin
    log.add(answer(4), DIGEST, "site")
    for number in range(5, 20):
        log.add(answer(number, "done"), DIGEST)
    log.tidy()
    for again in (log, CommandLogFile(PATH, disk, most_ids=5, tidy_bytes=0)):
        counted = [(one.id[-1], one.state) for one in again.attempts("policy a")]
        assert counted == [("1", "done"), ("3", "accepted")]
        assert again.origin(answer(4).id) == "site" and again.origin(answer(19).id) == ""
        assert {int(one.id, 16) for one in again.unanswered()} == {18, 19}
