"""Rules of the link: frames, waits, clocks, bandwidth, and the order of frames."""

from __future__ import annotations

import random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.blackbox.journal import channels
from amberbox.core.pacing import Backoff, TokenBucket
from amberbox.link import limits
from amberbox.link.client import OffsetEstimate
from amberbox.link.frames import (
    BeatFrame,
    Bye,
    FrameError,
    Hello,
    JournalPosition,
    LinkRow,
    Pong,
    RowsFrame,
    RunEnd,
    Welcome,
    WriterReach,
    encode,
    from_robot,
    from_server,
)
from amberbox.link.ledger import LinkAdmission, StaleEpochError
from amberbox.link.robot_end import RobotEnd
from amberbox.link.server_end import AdmitRobot, SendFrames, ServerEnd, StoreRows
from tests.link.memory_ledger import MemoryLedger

MS = 1_000_000
REACH = WriterReach(
    JournalPosition(1, 0),
    JournalPosition(1, 9),
    JournalPosition(1, 9),
    (RunEnd(1, "b", 9, closed=False),),
)


def hello(robot: str = "r1", protocol: int = limits.PROTOCOL) -> Hello:
    return Hello(robot, "s", "boot", {"watch": REACH}, "", 0, 0, "1", protocol)


def row(seq: int, channel: str = channels.STATUS, data: bytes = b"{}") -> LinkRow:
    return LinkRow("watch", 1, seq, channel, 5, data)


def admitted() -> ServerEnd:
    end = ServerEnd("r1")
    end.receive(hello())
    end.admitted(LinkAdmission(3, {}), 0, wants_folder=False, watch=())
    return end


def said(end: ServerEnd, frame: RowsFrame | BeatFrame | Hello) -> str:
    """Return the reason with which a connection is ended."""
    [deed] = end.receive(frame)
    assert isinstance(deed, SendFrames) and deed.ends and end.closed
    [bye] = deed.frames
    assert isinstance(bye, Bye)
    return bye.reason


def test_frames_come_back_as_they_went() -> None:
    rows = RowsFrame(
        3, 1, [row(1), row(2, data=bytes(range(256)))], {"watch": JournalPosition(1, 3)}
    )
    for frame in (hello(), rows, BeatFrame(1, 2, 3), Bye("x")):
        assert from_robot(encode(frame)) == frame
    for answer in (Welcome(1, {"watch": JournalPosition(2, 3)}, 5), Pong(1, 2), Bye("y", True)):
        assert from_server(encode(answer)) == answer


@given(st.integers(0, 10_000), st.integers(0, 7))
def test_one_changed_bit_is_seen(at: int, bit: int) -> None:
    data = bytearray(encode(RowsFrame(3, 1, [row(1)], {"watch": JournalPosition(1, 2)})))
    data[at % len(data)] ^= 1 << bit
    with pytest.raises(FrameError):
        from_robot(bytes(data))


@given(st.binary(max_size=300))
def test_no_bytes_do_more_than_be_refused(data: bytes) -> None:
    for content in (data, bytes(4) + data):
        with pytest.raises(FrameError):
            from_robot(content)


def test_frames_that_are_too_large_are_neither_sent_nor_read() -> None:
    with pytest.raises(FrameError):
        encode(RowsFrame(1, 1, [row(1, data=bytes(limits.FRAME_BYTES))], {}))
    with pytest.raises(FrameError):
        from_robot(bytes(limits.FRAME_BYTES + 1))


def test_nothing_is_taken_before_hello_nor_a_second_one() -> None:
    assert "hello first" in said(ServerEnd("r1"), BeatFrame(0, 1, 2))
    end = admitted()
    assert "already" in said(end, hello())


def test_a_robot_speaks_for_itself_only_and_our_protocol() -> None:
    assert "not that of r2" in said(ServerEnd("r1"), hello("r2"))
    assert "protocol 9" in said(ServerEnd("r1"), hello(protocol=9))


def test_an_older_epoch_is_refused() -> None:
    assert "epoch 2 is over" in said(admitted(), RowsFrame(2, 1, [row(1)], {}))
    ledger = MemoryLedger()
    first, second = ledger.admit(hello()), ledger.admit(hello())
    with pytest.raises(StaleEpochError):
        ledger.store(first.epoch, "s", [row(1)], {}, {"watch": REACH})
    assert ledger.store(second.epoch, "s", [row(1)], {}, {"watch": REACH}).new == (row(1),)


def test_a_frame_twice_is_one_and_a_missing_one_ends_it() -> None:
    end = admitted()
    [kept] = end.receive(RowsFrame(3, 1, [row(1)], {}))
    assert isinstance(kept, StoreRows) and kept.rows == [row(1)]
    assert end.receive(RowsFrame(3, 1, [row(1)], {})) == []
    assert "frame 2 is missing" in said(end, RowsFrame(3, 3, [row(2)], {}))
    assert end.receive(RowsFrame(3, 2, [row(2)], {})) == []


@pytest.mark.parametrize(
    "bad", [row(1, "amberbox/run"), LinkRow("bulk", 1, 1, channels.STATUS, 0, b"")]
)
def test_other_channels_and_writers_are_not_taken(bad: LinkRow) -> None:
    assert "are taken" in said(admitted(), RowsFrame(3, 1, [bad], {}))


def test_rows_at_a_known_position_with_other_content_are_put_aside() -> None:
    ledger = MemoryLedger()
    epoch = ledger.admit(hello()).epoch
    ledger.store(epoch, "s", [row(1)], {}, {"watch": REACH})
    stored = ledger.store(epoch, "s", [row(1, data=b"[]"), row(1)], {}, {"watch": REACH})
    assert (stored.new, stored.contradicting) == ((), (row(1, data=b"[]"),))
    assert ledger.rows["s", "watch", 1, 1] == row(1)


def test_what_is_urgent_goes_first_and_upto_waits_for_the_rest() -> None:
    end = RobotEnd()
    end.welcome(Welcome(1, {"watch": JournalPosition(1, 0)}, 0), {"watch": JournalPosition(1, 5)})
    end.offer_backlog("watch", [row(n) for n in range(5)], JournalPosition(1, 5))
    end.offer_fresh("watch", [row(5), row(6, channels.ALARM), row(7)], JournalPosition(1, 8))
    frames = [end.next_rows() for _ in range(3)]
    assert [[r.seq for r in f.rows] for f in frames if f] == [[6], [5, 7], [0, 1, 2, 3, 4]]
    assert [f.upto for f in frames if f] == [{}, {}, {"watch": JournalPosition(1, 8)}]
    assert end.next_rows() is None


def test_alarms_do_not_wait_behind_the_reports_of_an_action() -> None:
    end = RobotEnd()
    ends = {"watch": JournalPosition(1, 0), "act": JournalPosition(2, 0)}
    end.welcome(Welcome(1, {}, 0, capabilities=[limits.ACT_ROWS]), ends)
    reports = [LinkRow("act", 2, n, channels.COMMAND, 5, b"x" * 500) for n in range(2000)]
    end.offer_fresh("act", reports, JournalPosition(2, 2000))
    end.offer_fresh("watch", [row(0), row(1, channels.ALARM)], JournalPosition(1, 2))
    frames = [frame for frame in (end.next_rows() for _ in range(9)) if frame is not None]
    assert frames[0].rows == [row(1, channels.ALARM)] and frames[-1].rows == [row(0)]
    assert [one for frame in frames[1:-1] for one in frame.rows] == reports


def test_rows_of_the_command_process_go_only_where_they_are_taken() -> None:
    """Also not to an older server whose database still knows where a newer one was."""
    end = RobotEnd()
    ends = {"watch": JournalPosition(1, 0), "act": JournalPosition(2, 0)}
    end.welcome(Welcome(1, {"act": JournalPosition(2, 0)}, 0), ends)
    assert end.writers == ("main", "keep", "watch")
    with pytest.raises(KeyError):
        end.starts("act")


def test_the_server_takes_journals_of_later_writers_apart_from_those_it_always_knew() -> None:
    end = ServerEnd("r1")
    said_more = {"act": REACH, "of a later version": REACH}
    [admit] = end.receive(msgspec.structs.replace(hello(), more=said_more))
    assert isinstance(admit, AdmitRobot) and admit.hello.writers.keys() == {"watch", "act"}
    wrong = WriterReach(JournalPosition(1, 0), JournalPosition(1, 3), JournalPosition(1, 9))
    frame = msgspec.structs.replace(hello(), more={"act": wrong})
    assert "more is durable" in said(ServerEnd("r1"), frame)


def test_a_metered_network_carries_no_backlog() -> None:
    end = RobotEnd()
    end.welcome(Welcome(1, {"watch": JournalPosition(1, 0)}, 0), {"watch": JournalPosition(1, 5)})
    end.offer_backlog("watch", [row(0)], JournalPosition(1, 5))
    assert end.next_rows(("urgent", "status")) is None
    assert end.next_rows() is not None


def test_the_window_closes_until_something_is_acknowledged() -> None:
    end = RobotEnd()
    end.welcome(Welcome(1, {}, 0), {"watch": JournalPosition(1, 0)})
    end.offer_fresh("watch", [row(n) for n in range(100)], JournalPosition(1, 100))
    sent = 0
    while end.next_rows(most_bytes=1) is not None:
        sent += 1
    assert sent == limits.WINDOW


def test_waits_grow_to_their_limit_and_differ() -> None:
    backoff = Backoff(random.Random(1))
    waits = [backoff.failed() for _ in range(20)]
    assert 0.5 <= waits[0] <= 1 and all(15 <= wait <= 30 for wait in waits[8:])
    assert len(set(waits[8:])) == 12
    backoff.succeeded()
    assert backoff.failed() <= 1


def test_the_quickest_answer_tells_the_offset_best() -> None:
    estimate = OffsetEstimate()
    estimate.add(0, 100 * MS, 5_000 * MS, 1_100 * MS)
    assert estimate.offset_ns == 3_950 * MS
    estimate.add(200 * MS, 210 * MS, 5_155 * MS, 1_210 * MS)
    assert estimate.offset_ns == 3_950 * MS and estimate.round_ns == 10 * MS
    estimate.add(300 * MS, 700 * MS, 9_000 * MS, 1_700 * MS)
    assert estimate.round_ns == 10 * MS


def test_a_step_of_the_clock_begins_the_estimate_anew() -> None:
    estimate = OffsetEstimate()
    estimate.add(0, 10 * MS, 1_000 * MS, 10 * MS)
    estimate.add(1_000 * MS, 1_100 * MS, 2_050 * MS, 2_100 * MS)
    assert estimate.offset_ns == 0


@given(st.lists(st.integers(1, 5000), min_size=20, max_size=60))
def test_no_more_than_the_rate_is_let_through(sizes: list[int]) -> None:
    bucket, now = TokenBucket(10_000.0), 0.0
    for size in sizes:
        now += bucket.take(size, now)
    assert now >= (sum(sizes) - 2500) / 10_000 - 1e-6
    assert now <= sum(sizes) / 10_000


def test_hello_is_admitted_once_its_reach_can_be() -> None:
    assert isinstance(ServerEnd("r1").receive(hello())[0], AdmitRobot)
    wrong = WriterReach(JournalPosition(1, 0), JournalPosition(1, 3), JournalPosition(1, 9))
    frame = Hello("r1", "s", "b", {"watch": wrong}, "", 0, 0, "1")
    assert "more is durable" in said(ServerEnd("r1"), frame)
