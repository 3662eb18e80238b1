"""Frames of commands: who may send what when, what fits into one, and hostile ones."""

from __future__ import annotations

import zlib
from contextlib import suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.core.command import (
    COMMAND_BYTES,
    REASON_LENGTH,
    RESULT_BYTES,
    CommandAnswer,
    LeaseState,
)
from amberbox.link import limits
from amberbox.link.command_port import ActionAnnouncement, GateAnswers, MintedChallenge
from amberbox.link.frames import (
    AbortFrame,
    ActionsFrame,
    AnsweredFrame,
    AnswersFrame,
    BeatFrame,
    Bye,
    ChallengeFrame,
    CommandsFrame,
    ConfirmFrame,
    FrameError,
    Hello,
    LeaseFrame,
    RevokedFrame,
    RobotFrame,
    ServerFrame,
    UnknownFrameError,
    Welcome,
    encode,
    from_robot,
    from_server,
)
from amberbox.link.ledger import LinkAdmission
from amberbox.link.robot_end import RobotEnd
from amberbox.link.server_end import AdmitRobot, IgnoreFrame, LinkAction, SendFrames, ServerEnd
from tests.fuzzing import examples, fuzz
from tests.link.old_wire import encode as encode_anything

ID = "0123456789abcdef" * 2
CHALLENGE = bytes(range(32))


def answer(number: int, result: str = "", reason: str = "") -> CommandAnswer:
    return CommandAnswer(ID, "done", reason, result, 5, "boot", 6, number)


def connected(*capabilities: str) -> ServerEnd:
    end = ServerEnd("r1")
    hello = Hello("r1", "s", "b", {}, "", 0, 0, "1", capabilities=list(capabilities))
    assert isinstance(end.receive(hello)[0], AdmitRobot)
    end.admitted(LinkAdmission(3, {}), 0, wants_folder=False, watch=())
    return end


def welcomed(*said: str, capabilities: tuple[str, ...] = (limits.COMMANDS,)) -> RobotEnd:
    end = RobotEnd()
    end.welcome(Welcome(3, {}, 0, capabilities=list(said)), {}, capabilities)
    return end


def reason(actions: list[LinkAction]) -> str:
    [action] = actions
    assert isinstance(action, SendFrames) and action.ends
    [bye] = action.frames
    assert isinstance(bye, Bye)
    return bye.reason


UP: list[RobotFrame] = [
    ChallengeFrame(3, CHALLENGE, LeaseState(7, "server", "run", "")),
    ChallengeFrame(3, CHALLENGE, waiting=ID, by_code=True, tries=2),
    ActionsFrame(3, b'[{"name": "dock"}]'),
    AnswersFrame(3, 1, [answer(1), answer(2)]),
]
DOWN: list[ServerFrame] = [
    CommandsFrame([b"a", b"b"]),
    AnsweredFrame(5),
    RevokedFrame(["0123456789abcdef"]),
    LeaseFrame("renew", "server", "run", 7),
    AbortFrame(command=ID, who="anna"),
    ConfirmFrame(ID, "123456"),
]


def test_frames_come_back_as_they_went() -> None:
    assert [from_robot(encode(one)) for one in UP] == UP
    assert [from_server(encode(one)) for one in DOWN] == DOWN


def test_the_server_says_what_it_can_and_who_it_is() -> None:
    end = ServerEnd("r1")
    end.receive(Hello("r1", "s", "b", {}, "", 0, 0, "1"))
    welcome = end.admitted(
        LinkAdmission(3, {}), 0, wants_folder=False, watch=(), server_id="9f" * 16
    )
    known = [limits.COMMANDS, limits.ACT_ROWS, limits.PICTURES]
    assert welcome.capabilities == [*known, limits.DETECT_JOURNALS]
    assert welcome.server_id == "9f" * 16


@pytest.mark.parametrize("frame", UP, ids=lambda frame: type(frame).__name__)
def test_a_frame_of_a_capability_that_was_not_said_is_ignored(frame: RobotFrame) -> None:
    end = connected("another")
    assert end.receive(frame) == [IgnoreFrame()] and not end.closed
    assert connected(limits.COMMANDS).receive(frame) == [frame]


def test_both_ends_have_to_say_it() -> None:
    assert welcomed(limits.COMMANDS, "another").carries_commands
    assert not welcomed().carries_commands
    assert not welcomed(limits.COMMANDS, capabilities=()).carries_commands
    assert not welcomed("commands2").carries_commands


def test_nothing_unknown_is_taken_before_hello() -> None:
    assert "hello first" in reason(ServerEnd("r1").receive_unknown())
    end = connected()
    assert end.receive_unknown() == [IgnoreFrame()]
    end.closed = True
    assert end.receive_unknown() == []


def test_an_older_epoch_commands_nothing() -> None:
    end = connected(limits.COMMANDS)
    assert "epoch 2 is over" in reason(end.receive(ChallengeFrame(2, CHALLENGE)))


def test_answers_come_in_order_each_frame_once() -> None:
    end = connected(limits.COMMANDS)
    first = AnswersFrame(3, 1, [answer(4), answer(5)])
    assert end.receive(first) == [first]
    assert end.receive(first) == []
    assert "frame 2 of answers is missing" in reason(end.receive(AnswersFrame(3, 3, [answer(9)])))


@pytest.mark.parametrize("numbers", [(2, 1), (1, 1), (1, 0, 1)])
def test_answers_out_of_order_end_the_link(numbers: tuple[int, ...]) -> None:
    """They would be taken for stored by the highest of their numbers."""
    frame = AnswersFrame(3, 1, [answer(number) for number in numbers])
    assert "out of order" in reason(connected(limits.COMMANDS).receive(frame))


def test_answers_without_a_number_may_be_anywhere() -> None:
    frame = AnswersFrame(3, 1, [answer(0), answer(4), answer(0), answer(5)])
    assert connected(limits.COMMANDS).receive(frame) == [frame]


@pytest.mark.parametrize("actions", [b"", b"{", b"\xff", b"[" * 20_000, b"[1] 2"])
def test_actions_that_are_no_json_end_the_link(actions: bytes) -> None:
    assert "no JSON" in reason(connected(limits.COMMANDS).receive(ActionsFrame(3, actions)))


def test_many_answers_are_sent_in_frames_that_arrive() -> None:
    long = [answer(n, result="\N{EURO SIGN}" * 20_000) for n in range(1, 30)]
    short = [answer(n) for n in range(30, 900)]
    end = welcomed(limits.COMMANDS)
    frames = list(end.command_frames(GateAnswers([*long, *short])))
    frames += end.command_frames(GateAnswers([answer(900)]))
    server, received = connected(limits.COMMANDS), list[CommandAnswer]()
    for frame in frames:
        [action] = server.receive(from_robot(encode(frame)))
        assert isinstance(action, AnswersFrame)
        received += action.answers
    assert received == [*long, *short, answer(900)] and len(frames) > 10


def test_the_largest_answer_fits_into_a_frame() -> None:
    largest = answer(1, "\N{EURO SIGN}" * RESULT_BYTES, "\N{EURO SIGN}" * REASON_LENGTH)
    [frame] = welcomed(limits.COMMANDS).command_frames(GateAnswers([largest]))
    assert from_robot(encode(frame)) == frame


def test_reports_of_the_gate_carry_the_epoch() -> None:
    end = welcomed(limits.COMMANDS)
    lease = LeaseState(1, "h", "r")
    minted = MintedChallenge(CHALLENGE, lease, ID, by_code=True, tries=1)
    [frame] = end.command_frames(minted)
    assert frame == ChallengeFrame(3, CHALLENGE, lease, ID, by_code=True, tries=1)
    assert list(end.command_frames(ActionAnnouncement(b"[]"))) == [ActionsFrame(3, b"[]")]
    assert list(end.command_frames(GateAnswers([]))) == []


def raw(tag: object, **fields: object) -> bytes:
    """Return a frame with any content and a sound checksum."""
    content = msgspec.msgpack.encode({"type": tag, **fields})
    return zlib.crc32(content).to_bytes(4, "little") + content


GOOD: dict[str, dict[str, Any]] = {
    "challenge": {"epoch": 3, "challenge": CHALLENGE, "lease": {"number": 1}},
    "actions": {"epoch": 3, "announcement": b"[]"},
    "answers": {"epoch": 3, "number": 1, "answers": [{"id": ID, "state": "done"}]},
}
BAD_UP: list[tuple[str, dict[str, Any]]] = [
    ("challenge", {"challenge": b"short"}),
    ("challenge", {"challenge": bytes(33)}),
    ("challenge", {"challenge": "text" * 8}),
    ("challenge", {"lease": {"number": -1}}),
    ("challenge", {"lease": {"number": 2**63}}),
    ("challenge", {"lease": {"holder": "h" * 129}}),
    ("challenge", {"lease": {"run": "two\nlines"}}),
    ("challenge", {"epoch": -1}),
    ("challenge", {"waiting": "the laser"}),
    ("challenge", {"waiting": ID, "by_code": "yes"}),
    ("challenge", {"tries": -1}),
    ("actions", {"announcement": bytes(limits.ACTIONS_BYTES + 1)}),
    ("actions", {"announcement": None}),
    ("answers", {"answers": [{"id": ID, "state": "well"}]}),
    ("answers", {"answers": [{"id": ID + "0", "state": "done"}]}),
    ("answers", {"answers": [{"id": ID.upper(), "state": "done"}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "number": 2**63}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "number": -1}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "at_ns": 2**64 - 1}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "mono_ns": 1.5}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "reason": "r" * (REASON_LENGTH + 1)}]}),
    ("answers", {"answers": [{"id": ID, "state": "done", "result": "r" * (RESULT_BYTES + 1)}]}),
    ("answers", {"answers": [{"id": ID, "state": "done"}] * (limits.ANSWERS_COUNT + 1)}),
    ("answers", {"number": 2**64 - 1}),
]
HELLO = {"robot": "r1", "store_id": "s", "boot_id": "b", "writers": {}, "config_hash": "",
         "wall_ns": 0, "mono_ns": 0, "version": "1"}  # fmt: skip


@pytest.mark.parametrize(("tag", "fields"), BAD_UP)
def test_bad_content_of_a_known_frame_is_no_frame(tag: str, fields: dict[str, Any]) -> None:
    from_robot(raw(tag, **GOOD[tag]))
    with pytest.raises(FrameError) as refused:
        from_robot(raw(tag, **{**GOOD[tag], **fields}))
    assert not isinstance(refused.value, UnknownFrameError)


@pytest.mark.parametrize(
    "said", [["c" * 65], ["c"] * 65, "commands1", [1], {"commands1": 1}, None]
)  # fmt: skip
def test_capabilities_are_bounded(said: object) -> None:
    assert from_robot(raw("hello", **HELLO, capabilities=["commands1", "more"]))
    with pytest.raises(FrameError):
        from_robot(raw("hello", **HELLO, capabilities=said))
    with pytest.raises(FrameError):
        from_server(raw("welcome", epoch=1, cursor={}, server_wall_ns=0, capabilities=said))


BAD_DOWN: list[tuple[str, dict[str, Any]]] = [
    ("commands", {"commands": [bytes(COMMAND_BYTES + 1)]}),
    ("commands", {"commands": [b""] * (limits.COMMANDS_COUNT + 1)}),
    ("commands", {"commands": "text"}),
    ("answered", {"number": -1}),
    ("answered", {"number": 2**63}),
    ("revoked", {"keys": ["0123456789abcdef"] * (limits.KEYS_COUNT + 1)}),
    ("revoked", {"keys": ["not a key"]}),
    ("lease", {"do": "steal", "holder": "h", "run": "r"}),
    ("lease", {"do": "take", "holder": "h" * 129, "run": "r"}),
    ("lease", {"do": "renew", "holder": "h", "run": "r", "number": -1}),
    ("abort", {"run": "r" * 129}),
    ("abort", {"command": 5}),
    ("abort", {"who": "w" * 129}),
    ("code", {"command": "", "code": "123456"}),
    ("code", {"command": ID, "code": "1" * 17}),
    ("welcome", {"epoch": 1, "cursor": {}, "server_wall_ns": 0, "server_id": "9" * 129}),
]


@pytest.mark.parametrize(("tag", "fields"), BAD_DOWN)
def test_a_robot_takes_no_bad_content_either(tag: str, fields: dict[str, Any]) -> None:
    with pytest.raises(FrameError) as refused:
        from_server(raw(tag, **fields))
    assert not isinstance(refused.value, UnknownFrameError)


@pytest.mark.parametrize(
    "data",
    [
        raw("t" * (limits.CAPABILITY_LENGTH + 1)), raw(5), raw(None), raw(b"later"),
        raw("later")[:-1], bytes(4) + raw("later")[4:],
        encode_anything([1, 2]),  # type: ignore[arg-type]  # no frame
    ],
)  # fmt: skip
def test_what_has_no_sound_tag_is_no_frame_at_all(data: bytes) -> None:
    for read in (from_robot, from_server):
        with pytest.raises(FrameError) as refused:
            read(data)
        assert not isinstance(refused.value, UnknownFrameError)


@pytest.mark.parametrize("tag", ["later", "", "hello\n", "Hello"])
def test_an_unknown_tag_is_unknown_whatever_it_carries(tag: str) -> None:
    for read in (from_robot, from_server):
        with pytest.raises(UnknownFrameError):
            read(raw(tag, epoch=-1, anything=[{}, b"x"]))


def test_frames_of_the_other_end_are_unknown() -> None:
    for up in UP:
        with pytest.raises(UnknownFrameError):
            from_server(encode(up))
    for down in DOWN:
        with pytest.raises(UnknownFrameError):
            from_robot(encode(down))


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
    | st.binary(max_size=64),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner,
                                                               max_size=4),
    max_leaves=12,
)  # fmt: skip
_TAGS = st.sampled_from(
    ["challenge", "actions", "answers", "commands", "answered", "revoked", "lease", "abort",
     "code", "hello", "welcome", "later"]
)  # fmt: skip
_FIELDS = st.sampled_from(
    ["epoch", "challenge", "lease", "announcement", "answers", "number", "commands", "keys", "do",
     "holder", "run", "command", "capabilities", "server_id"]
)  # fmt: skip


@fuzz
@settings(max_examples=examples(300))
@given(_TAGS, st.dictionaries(_FIELDS, _VALUES, max_size=6))
def test_hostile_frames_do_no_more_than_be_refused(tag: str, fields: dict[str, Any]) -> None:
    end = connected(limits.COMMANDS)
    data = raw(tag, **fields)
    try:
        actions = end.receive(from_robot(data))
    except UnknownFrameError:
        assert end.receive_unknown() == [IgnoreFrame()]
    except FrameError:
        pass
    else:
        assert all(
            isinstance(one, SendFrames | ChallengeFrame | ActionsFrame | AnswersFrame)
            for one in actions
        )
    with suppress(FrameError):
        assert encode(from_server(data))
    assert end.closed or end.receive(BeatFrame(3, 1, 2))
