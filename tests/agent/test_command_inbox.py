"""The inbox of the command process: what stops the robot first, all of it bounded."""

from __future__ import annotations

from amberbox.agent import command_inbox
from amberbox.agent.command_inbox import CommandInbox
from amberbox.link.frames import (
    AbortFrame,
    AnsweredFrame,
    CommandsFrame,
    LeaseFrame,
    RevokedFrame,
    ServerCommandFrame,
)

RENEW = LeaseFrame("renew", "anna", "run-1", 3)


def filled(*frames: ServerCommandFrame) -> CommandInbox:
    inbox = CommandInbox()
    for frame in frames:
        inbox.add(frame)
    return inbox


def commands_of(frames: list[ServerCommandFrame]) -> list[bytes]:
    return [one for frame in frames if isinstance(frame, CommandsFrame) for one in frame.commands]


def test_what_stops_comes_first_and_commands_last_in_their_order() -> None:
    take = LeaseFrame("take", "anna", "run-1")
    inbox = filled(
        CommandsFrame([b"1", b"2"]), take, AnsweredFrame(7), RENEW, RevokedFrame(["k"]),
        CommandsFrame([b"3"]), AbortFrame("run-1"),
    )  # fmt: skip
    assert list(inbox.take(0.0)) == [
        AbortFrame("run-1"), RevokedFrame(["k"]), AnsweredFrame(7), RENEW, take,
        CommandsFrame([b"1", b"2", b"3"]),
    ]  # fmt: skip
    assert list(inbox.take(0.0)) == []


def test_commands_come_a_few_in_a_turn_and_at_most_so_many_a_second() -> None:
    inbox, found = CommandInbox(), list[bytes]()
    sent = [b"%d" % n for n in range(600)]
    for start in range(0, 600, 100):
        inbox.add(CommandsFrame(sent[start : start + 100]))
    for turn in range(1000):  # 10 s
        now = commands_of(list(inbox.take(turn / 100)))
        assert len(now) <= command_inbox.AT_ONCE
        found += now
        assert len(found) <= command_inbox.BURST + command_inbox.COMMANDS_PER_S * turn / 100 + 1
    assert found == sent[: len(found)] and len(found) >= 295


def test_large_commands_count_as_several() -> None:
    inbox, large = CommandInbox(), bytes(60_000)
    for _ in range(3):
        inbox.add(CommandsFrame([large] * 20))
    found = [command for _ in range(100) for command in commands_of(list(inbox.take(0.0)))]
    assert 10 <= len(found) <= 15 and inbox.has_commands


def test_without_room_for_actors_commands_wait() -> None:
    inbox = filled(CommandsFrame([b"1", b"2"]), RENEW)
    assert list(inbox.take(0.0, room=0)) == [RENEW] and inbox.has_commands
    assert commands_of(list(inbox.take(0.0, room=1))) == [b"1"]


def test_of_a_flood_a_bounded_part_waits_and_the_rest_is_counted() -> None:
    inbox = CommandInbox()
    for _ in range(30):
        inbox.add(CommandsFrame([b"x"] * 100))
    assert inbox.dropped == 3000 - command_inbox.MOST_COMMANDS
    inbox.forget_commands()
    for _ in range(3):
        inbox.add(CommandsFrame([b"x" * 60_000] * 100))
    assert inbox.dropped == 2000 + 300 - command_inbox.MOST_BYTES // 60_000
    for number in range(5000):
        inbox.add(LeaseFrame("take", "anna", f"run-{number}"))
        inbox.add(LeaseFrame("renew", "anna", "run-1", number))
    frames = list(inbox.take(0.0, room=0))
    assert len(frames) <= 32 and LeaseFrame("renew", "anna", "run-1", 4999) in frames


def test_equal_requests_of_a_turn_count_once() -> None:
    inbox = filled(*[RENEW] * 1000, *[AbortFrame()] * 1000, RENEW)
    assert list(inbox.take(0.0)) == [AbortFrame(), RENEW]


def test_more_aborts_than_anybody_needs_stop_everything() -> None:
    inbox = filled(*(AbortFrame(command=f"{n:032x}") for n in range(20)))
    assert len(list(inbox.take(0.0))) == 20
    inbox = filled(*(AbortFrame(command=f"{n:032x}") for n in range(20_000)))
    assert list(inbox.take(0.0)) == [AbortFrame()]
    stopped = 0
    for turn in range(100):  # a second
        inbox.add(AbortFrame(command=f"{turn:032x}"))
        stopped += list(inbox.take(turn / 100)) == [AbortFrame()]
    assert stopped > 80
